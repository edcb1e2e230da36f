"""Whether files can be written, found out before long work, in a time linear in their number."""

from pathlib import Path

import pytest

from rdstitch import outputs as atomic
from rdstitch.errors import OutputError
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


@pytest.mark.parametrize("overwrite", [False, True])
def test_no_input_is_written_over_by_whatever_name(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "from").mkdir()
    (tmp_path / "from" / "a.png").write_bytes(b"x")
    (tmp_path / "to").symlink_to("from")
    with pytest.raises(OutputError, match="is read as input"):
        check_outputs([tmp_path / "to" / "b.png", tmp_path / "to" / "a.png"], overwrite, [tmp_path / "from" / "a.png"])
