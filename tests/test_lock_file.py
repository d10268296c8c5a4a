"""A folder is written to by one process at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vslam.errors import InputError
from vslam.lock_file import locked


def test_a_living_process_keeps_others_out(tmp_path):
    lock = tmp_path / ".lock"
    with (
        locked(lock, tmp_path, "works here"),
        pytest.raises(InputError, match=rf"{tmp_path}: process {os.getpid()} works here; wait"),
        locked(lock, tmp_path, "works here"),
    ):
        pytest.fail("the lock was taken twice")
    assert not list(tmp_path.iterdir())


def test_a_lock_is_given_back_after_an_error(tmp_path):
    with pytest.raises(KeyError), locked(tmp_path / ".lock", tmp_path, "works here"):
        raise KeyError
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kept", ["killed", "younger", "", "no number"])
def test_what_a_killed_process_left_is_passed_over(tmp_path, kept):
    lock = tmp_path / ".lock"
    if kept == "killed":
        command = (
            "import os, signal, sys; from pathlib import Path; from vslam.lock_file import locked\n"
            "with locked(Path(sys.argv[1]), Path(), ''): os.kill(os.getpid(), signal.SIGKILL)"
        )
        subprocess.run([sys.executable, "-c", command, lock], check=False)
        assert lock.exists()
    else:
        lock.write_text(str(os.getpid()) if kept == "younger" else kept)
        os.utime(lock, (1e9, 1e9))  # this process did not live then
    with locked(lock, tmp_path, "works here"):
        assert Path(lock).read_text() == str(os.getpid())
    assert not list(tmp_path.iterdir())
