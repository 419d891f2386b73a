"""What the tests of reading share."""

import pytest


@pytest.fixture
def written(tmp_path):
    """Write a table as CSV, and return its path."""

    def write(table):
        table.to_csv(tmp_path / "log.csv", index=False)
        return tmp_path / "log.csv"

    return write
