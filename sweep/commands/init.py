"""`sweep init`: a grid file to begin with."""

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from sweep.messages import UserError


def init(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="The file to write, or the folder for it.")] = Path("grid.toml"),
) -> None:
    """Write a grid file to begin with. A file that is there already is left alone."""
    file = path / "grid.toml" if path.is_dir() else path
    text = (resources.files("sweep") / "templates" / "grid.toml").read_text("utf-8").replace("grid.toml", str(file))
    try:
        with open(file, "x", encoding="utf-8") as opened:
            opened.write(text)
    except FileExistsError:
        raise UserError(f"{file}: is there already; `sweep init PATH` writes another") from None
    typer.echo(f"wrote {file}; change it, then: sweep plan {file}")
