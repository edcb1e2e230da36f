"""The property tests again, on examples drawn at random: what they look for differs from run to run."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_properties_hold_for_random_examples() -> None:
    command = [sys.executable, "-m", "pytest", "--quiet", "-m", "hypothesis", "-p", "no:cacheprovider"]
    command += ["--hypothesis-profile", "search"]
    done = subprocess.run([*command, Path(__file__).parent], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
