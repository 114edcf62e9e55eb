"""The documents say what is true: commands exist, links lead somewhere, the layout is as described."""

import re
import subprocess
from pathlib import Path

import pytest

from agents.registry import ALGORITHMS

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")] + sorted((ROOT / "docs").rglob("*.md"))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_and_picture_leads_to_a_file(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_module_that_is_named_exists(document):
    for name in set(re.findall(r"`((?:agents|sweep|cluster|analysis)[/.][\w/.]+)`", document.read_text())):
        path = ROOT / (name if "/" in name else name.replace(".", "/"))
        if path.exists() or path.with_suffix(".py").exists():
            continue
        module, attribute = path.parent.with_suffix(".py"), path.name
        if path.parent.is_dir():
            assert f'"{attribute}"' in (path.parent / "__init__.py").read_text(), name
            continue
        assert module.exists(), name
        assert re.search(rf"^(def|class) {attribute}\b|^{attribute}\b", module.read_text(), re.MULTILINE), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_make_target_that_is_named_exists(document):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)`", document.read_text())) <= targets


def number_range(hyper):
    low = "> 0" if hyper.positive else f"≥ {hyper.minimum:g}"
    return low + (f", ≤ {hyper.maximum:g}" if hyper.maximum is not None else "")


def hyperparameter_rows():
    """A line of the grid reference for each hyperparameter, from what the algorithms declare."""
    tables = {name: algorithm.hypers for name, algorithm in ALGORITHMS.items()}
    for name in dict.fromkeys(name for hypers in tables.values() for name in hypers.table):
        owners = [algorithm for algorithm, hypers in tables.items() if name in hypers.table]
        hyper, default = tables[owners[0]].table[name], getattr(tables[owners[0]](), name)
        shown = (
            f'"{default}"' if isinstance(default, str) else str(list(default)) if isinstance(default, tuple) else f"{default:g}"
        )
        valid = {"choice": ", ".join(f'"{choice}"' for choice in hyper.choices), "widths": "list of widths"}.get(hyper.type)
        if valid is None:
            ranges = {algorithm: number_range(tables[algorithm].table[name]) for algorithm in owners}
            most = max(ranges.values(), key=list(ranges.values()).count)
            valid = most + "".join(f" ({algorithm}: {other})" for algorithm, other in ranges.items() if other != most)
        where = "all" if len(owners) == len(tables) else ", ".join(owners)
        yield f"| `{name}` | {hyper.meaning} | {valid} | {shown} | {where} |"


def test_the_grid_reference_lists_every_hyperparameter_as_it_is_declared():
    text = (ROOT / "docs" / "grid.md").read_text()
    rows = list(hyperparameter_rows())
    assert [line for line in text.splitlines() if line.startswith("| `") and line.count("|") == 6] == rows, "\n".join(rows)


def test_every_package_is_listed_for_installation():
    import tomllib

    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    top = ("agents", "sweep", "analysis", "cluster")
    found = [str(file.parent.relative_to(ROOT)).replace("/", ".") for name in top for file in (ROOT / name).rglob("__init__.py")]
    assert sorted(listed) == sorted(found)


def test_no_generated_file_is_tracked():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    assert tracked
    assert not [
        file
        for file in tracked
        if re.search(r"(^|/)(results|figures|__pycache__|\.venv)/", file) and not file.startswith(("analysis/", "tests/"))
    ]
