"""One small store, whose numbers the tests know by hand."""

from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest
from synthetic_store import SyntheticStore, build

from analysis import connect


@pytest.fixture(scope="session")
def small_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("stores") / "small")


@pytest.fixture(scope="module")
def connection(small_store: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    connection = connect(small_store)
    yield connection
    connection.close()


@pytest.fixture
def empty_store(tmp_path: Path) -> Path:
    return SyntheticStore(tmp_path / "empty").write_studies()
