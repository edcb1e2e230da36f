"""Whether files can be written, found out before long work, in a time linear in their number."""

from pathlib import Path

import pytest

from rdstitch import outputs as atomic
from rdstitch.outputs import check_outputs


def test_each_file_is_looked_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, made = ([tmp_path / folder / f"{number}.png" for number in range(200)] for folder in ("from", "to"))
    for file in (*given, *made):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"x")
    looked: list[Path] = []
    identity = atomic._identity

    def counted(file: Path) -> tuple[int, int] | None:
        looked.append(file)
        return identity(file)

    monkeypatch.setattr(atomic, "_identity", counted)
    check_outputs(made, True, given)
    assert len(looked) <= 3 * 200
