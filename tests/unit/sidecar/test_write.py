"""The sidecar names the versions of what it was made with, whichever wheels these come from."""

from importlib.metadata import PackageNotFoundError

import cv2
import pytest

from rdstitch.sidecar import write


def test_another_wheel_of_opencv_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_rdstitch(name: str) -> str:
        if name != "rdstitch":
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr("importlib.metadata.version", only_rdstitch)
    found = write.versions()
    assert (found["rdstitch"], found["opencv"]) == ("1.2", cv2.__version__)
    assert all(found.values())
