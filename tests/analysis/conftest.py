"""Two small stores: one whose numbers the tests know by hand, and one that was really trained."""

from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest
import real_study
from synthetic_store import SyntheticStore, build

from analysis import connect


@pytest.fixture(scope="session")
def small_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("stores") / "small")


@pytest.fixture(scope="session")
def real_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Studies chapter-6, figure-7-1, figure-7-2 and chapter-3 in small (`real_study`). Only to be read."""
    return real_study.train(tmp_path_factory.mktemp("stores") / "real")


@pytest.fixture(scope="module")
def connection(small_store: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    connection = connect(small_store)
    yield connection
    connection.close()


@pytest.fixture
def empty_store(tmp_path: Path) -> Path:
    return SyntheticStore(tmp_path / "empty").write_studies()
