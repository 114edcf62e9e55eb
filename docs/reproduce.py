"""Run every command of docs/reproduction.md and README.md that shows the sample store: print what it prints, redraw the pictures.

    python docs/reproduce.py            # write the outputs into the pages, and the pictures beside them
    python docs/reproduce.py --check    # exit code 1 if a command prints anything else than a page says

A block ```console``` has one command after `$ `, over several lines where they are indented, and then its output. Pictures go
where `--out` says, seen from this folder. With --check they are drawn into a temporary one, and each picture of the page must be
there.
"""

import argparse
import contextlib
import difflib
import re
import shlex
import sys
import tempfile
from pathlib import Path

from typer.testing import CliRunner

from sweep.cli import app

DOCS = Path(__file__).resolve().parent
PAGES = (DOCS / "reproduction.md", DOCS.parent / "README.md")
_BLOCK = re.compile(r"```console\n\$ ([^\n]*\n(?:    [^\n]*\n)*)(.*?)```", re.DOTALL)


def printed(command: str) -> str:
    """Return what a command prints; SystemExit where it fails."""
    words = shlex.split(command)
    if words[0] != "sweep":
        raise SystemExit(f"{words[0]}: the pages run `sweep` and nothing else")
    ran = CliRunner().invoke(app, words[1:], env={"COLUMNS": "200", "SWEEP_STORE": None})
    if ran.exit_code:
        raise SystemExit(f"{command}\n{ran.output}\n{ran.exception}")
    return "\n".join(line.rstrip() for line in ran.stdout.splitlines()) + "\n"


def reproduced(page: str) -> str:
    """Return the page with the outputs of its commands as they are now; what they draw is written below the working directory."""

    def again(block: re.Match[str]) -> str:
        print(f"$ {block[1].rstrip()}", flush=True)
        output = printed(block[1])
        print(output, flush=True)
        return f"```console\n$ {block[1]}{output}```"

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
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if arguments.check else DOCS
            with contextlib.chdir(folder):
                found = reproduced(said)
            missing = [picture for picture in pictures(said) if not (folder / picture).is_file()]
        if missing:
            raise SystemExit(f"{page.name}: no command draws {', '.join(missing)}")
        if not arguments.check:
            page.write_text(found, encoding="utf-8")
        elif found != said:
            changed = True
            sys.stdout.writelines(difflib.unified_diff(said.splitlines(True), found.splitlines(True), page.name, "now"))
    for file in (DOCS / "images" / "reproduction").rglob("*.csv"):  # tables: the page has them
        file.unlink()
    if changed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
