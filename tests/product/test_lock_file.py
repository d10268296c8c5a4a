"""Only one process at a time writes to a folder."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from vslam.support.errors import InputError
from vslam.support.lock_file import locked


def test_a_living_process_keeps_others_out(tmp_path):
    lock = tmp_path / ".lock"
    with (
        locked(lock, tmp_path, "works here"),
        pytest.raises(InputError, match=f"{tmp_path}: another process works here; wait"),
        locked(lock, tmp_path, "works here"),
    ):
        pytest.fail("the lock was taken twice")
    assert not list(tmp_path.iterdir())


def test_a_lock_is_given_back_after_an_error(tmp_path):
    with pytest.raises(KeyError), locked(tmp_path / ".lock", tmp_path, "works here"):
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_left_is_passed_over(tmp_path):
    lock = tmp_path / ".lock"
    command = (
        "import os, signal, sys; from pathlib import Path\n"
        "from vslam.support.lock_file import locked\n"
        "with locked(Path(sys.argv[1]), Path(), ''): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", command, lock], check=False)
    assert lock.exists()
    with locked(lock, tmp_path, "works here"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_change_of_the_clock_lets_nobody_in(tmp_path):
    lock = tmp_path / ".lock"
    with locked(lock, tmp_path, "works here"):
        os.utime(lock, (1e9, 1e9))
        with pytest.raises(InputError), locked(lock, tmp_path, "works here"):
            pytest.fail("the lock was taken twice")


RACER = """
import sys, time
from pathlib import Path
from vslam.support.errors import InputError
from vslam.support.lock_file import locked

folder = Path(sys.argv[1])
entered = 0
while entered < 100:
    try:
        with locked(folder / ".lock", folder, "works here"):
            (folder / "inside").touch(exist_ok=False)
            time.sleep(0.0002)
            (folder / "inside").unlink()
            entered += 1
        (folder / ".lock").write_text("999999999")  # left by a killed process
    except InputError:
        pass
"""


@pytest.mark.slow
def test_processes_that_race_get_in_one_at_a_time(tmp_path):
    """A process that releases the lock removes a file that others may have opened just before."""
    command = [sys.executable, "-c", RACER, str(tmp_path)]
    racers = [subprocess.Popen(command) for _ in range(4)]
    assert [racer.wait(timeout=300) for racer in racers] == [0] * 4
