"""Builds the native kernels of `agents/kernels/src`: one shared library with a variant for each instruction set.

Nothing here needs torch or headers of Python. Where there is no C++ compiler, or it refuses, the install succeeds without them,
and the pure-torch engine is used; a variant that the compiler does not know is left out.
"""

import logging
import os
import platform
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CCompilerError, CompileError, ExecError, LinkError, PlatformError

SOURCE = Path("agents/kernels/src")
FLAGS = ["-O3", "-std=c++17", "-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"]
QUIET = ["-Wno-psabi", "-Wno-maybe-uninitialized", "-Wno-unknown-warning-option"]
VARIANTS = {
    "x86_64": {
        "avx512": ["-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mavx2", "-mfma"],
        "avx2": ["-mavx2", "-mfma"],
    },
    "aarch64": {"neon": []},
}
VARIANTS["amd64"], VARIANTS["arm64"] = VARIANTS["x86_64"], VARIANTS["aarch64"]


class BuildKernels(build_ext):
    """Compiles the source once a variant, and `dispatch.cpp` with the names of those that compiled."""

    def build_extension(self, ext: Extension) -> None:
        """Build the library, or say why it is left out: then none that was built before stays in its place."""
        name = Path(self.get_ext_fullpath(ext.name)).name
        Path(self.get_ext_fullpath(ext.name)).unlink(missing_ok=True)
        if self.editable_mode:
            (SOURCE.parent / name).unlink(missing_ok=True)
        if os.environ.get("SWEEP_NO_NATIVE"):
            return self.warn("native kernels left out: SWEEP_NO_NATIVE is set")
        objects, built = [], []
        for variant, flags in VARIANTS.get(platform.machine().lower(), {}).items():
            try:
                objects += self._compiled("kernel.cpp", variant, [f"-DVARIANT={variant}", *flags])
                built.append(variant)
            except (CCompilerError, CompileError, ExecError, PlatformError, OSError) as error:
                self.warn(f"native kernels: variant {variant} left out: {error}")
        if not built:
            return self.warn("native kernels left out: the pure-torch engine will be used")
        try:
            objects += self._compiled("dispatch.cpp", "dispatch", [f"-DHAVE_{variant}" for variant in built])
            target = Path(self.get_ext_fullpath(ext.name))
            target.parent.mkdir(parents=True, exist_ok=True)
            self.compiler.link_shared_object(objects, str(target), target_lang="c++")
        except (CCompilerError, CompileError, ExecError, LinkError, PlatformError, OSError) as error:
            return self.warn(f"native kernels left out: {error}")
        return self.announce(f"native kernels built: {', '.join(built)}", level=logging.INFO)

    def _compiled(self, name: str, folder: str, flags: list[str]) -> list[str]:
        return self.compiler.compile(
            [str(SOURCE / name)],
            output_dir=str(Path(self.build_temp) / folder),
            extra_postargs=[*FLAGS, *QUIET, *flags],
        )


setup(
    ext_modules=[Extension("agents.kernels._native", sources=[str(SOURCE / "kernel.cpp")], optional=True)],
    cmdclass={"build_ext": BuildKernels},
)
