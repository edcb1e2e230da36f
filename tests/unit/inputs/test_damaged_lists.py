"""Lists and tables whose lines are longer than any that is meant."""

from pathlib import Path

import pytest

from rdstitch.errors import InputError
from rdstitch.inputs.find import find_images
from rdstitch.inputs.measurements import with_attitudes


def test_a_pattern_longer_than_any_name_is_refused_at_once(tmp_path: Path) -> None:
    """To compile one of 75,000 characters took 37 seconds."""
    names = tmp_path / "list.txt"
    names.write_text("*." + "x" * 75_000, encoding="utf-8")
    with pytest.raises(InputError, match="a pattern of 75002 characters"):
        find_images([f"@{names}"])


@pytest.mark.parametrize("text", ["x" * 140_000, "name,psi,theta\na.jpg,0,0\n" + "x" * 140_000])
def test_a_table_with_an_endless_field_is_named(tmp_path: Path, text: str) -> None:
    table = tmp_path / "attitudes.csv"
    table.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"attitudes.csv: is not a CSV file"):
        with_attitudes([], table)
