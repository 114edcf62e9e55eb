"""Run every command of docs/reproduction.md and README.md that shows the sample store: print what it prints, redraw the pictures.

    python docs/reproduce.py            # write the outputs into the pages, and the pictures beside them
    python docs/reproduce.py --check    # exit code 1 if a command prints anything else than a page says

A block ```console``` has one command after `$ `, over several lines as long as a quote is open, and then its output. Pictures are
drawn into a temporary folder, where `--out` says; those of the page must be among them.
"""

import argparse
import contextlib
import difflib
import re
import shlex
import shutil
import sys
import tempfile
from pathlib import Path

from typer.testing import CliRunner

from sweep.cli import app

DOCS = Path(__file__).resolve().parent
PAGES = (DOCS / "reproduction.md", DOCS.parent / "README.md")
_BLOCK = re.compile(r"```console\n\$ (.*?)```", re.DOTALL)


def printed(command: str) -> str:
    """Return what a command prints; SystemExit where it fails."""
    words = shlex.split(command)
    if words[0] != "sweep":
        raise SystemExit(f"{words[0]}: the pages run `sweep` and nothing else")
    ran = CliRunner().invoke(app, words[1:], env={"COLUMNS": "200", "SWEEP_STORE": None})
    if ran.exit_code:
        raise SystemExit(f"{command}\n{ran.output}\n{ran.exception}")
    return "\n".join(line.rstrip() for line in ran.stdout.splitlines()) + "\n"


def commands(page: str) -> list[str]:
    """Return the commands of a page, without their outputs."""
    return [_command(block[1]) for block in _BLOCK.finditer(page)]


def _command(block: str) -> str:
    """Return the command that a block begins with: lines until all quotes are closed."""
    lines = block.splitlines(keepends=True)
    for count in range(1, len(lines) + 1):
        with contextlib.suppress(ValueError):
            shlex.split("".join(lines[:count]))
            return "".join(lines[:count])
    raise SystemExit(f"a quote is never closed: {lines[0]}")


def reproduced(page: str) -> str:
    """Return the page with the outputs of its commands as they are now; what they draw is written below the working directory."""

    def again(block: re.Match[str]) -> str:
        command = _command(block[1])
        print(f"$ {command.rstrip()}", flush=True)
        output = printed(command)
        print(output, flush=True)
        return f"```console\n$ {command}{output}```"

    return _BLOCK.sub(again, page)


def pictures(page: str) -> list[str]:
    """Return the pictures of the reproduction that the page shows."""
    return re.findall(r"!\[[^]]*\]\((images/reproduction/[^)]+)\)", page)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing, and fail where the page says something else")
    arguments = parser.parse_args()
    changed = False
    for page in PAGES:
        said = page.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            with contextlib.chdir(folder):
                found = reproduced(said)
            missing = [picture for picture in pictures(said) if not Path(folder, picture).is_file()]
            if missing:
                raise SystemExit(f"{page.name}: no command draws {', '.join(missing)}")
            for picture in [] if arguments.check else pictures(said):
                (DOCS / picture).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(Path(folder, picture), DOCS / picture)
        if not arguments.check:
            page.write_text(found, encoding="utf-8")
        elif found != said:
            changed = True
            sys.stdout.writelines(difflib.unified_diff(said.splitlines(True), found.splitlines(True), page.name, "now"))
    if changed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
