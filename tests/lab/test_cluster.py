"""A benchmark on a local Dask cluster loses no cell if a worker is killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import psutil
import pytest
from stub_runner import COMMAND, started, wait_for

from vslam.config import Config
from vslam.support.errors import InputError
from vslam_lab.bench import execute
from vslam_lab.bench.cluster import run_on_cluster
from vslam_lab.bench.grid import make_grid

CONFIG = Config().model_dump_json(indent=2) + "\n"
CELLS = make_grid("kitti", ["00", "05"], ["none", "brightness:1"], ["none", "bow"], 1)

pytest.importorskip("distributed", reason="no dask here: pip install 'vslam[cluster]'")


@pytest.fixture
def cluster(stub: Path, tmp_path: Path) -> Iterator[tuple[str, list[psutil.Popen]]]:
    """The address of a scheduler, and its two workers with one thread each."""
    log = tmp_path / "dask.txt"
    processes: list[psutil.Popen] = []

    def start(*words: str) -> None:
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
        with log.open("ab") as output:
            processes.append(
                psutil.Popen(command, stdout=output, stderr=subprocess.STDOUT, cwd=tmp_path)
            )

    try:
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        at = r"Scheduler at:\s+(tcp://127\.0\.0\.1:\d+)"
        wait_for(lambda: re.search(at, log.read_text()), 200)
        found = re.search(at, log.read_text())
        assert found
        for name in ("one", "two"):
            words = ["dask_worker", found[1], "--name", name, "--nthreads", "1", "--no-nanny"]
            start(
                *words, "--host", "127.0.0.1", "--no-dashboard", "--local-directory", str(tmp_path)
            )
        wait_for(lambda: log.read_text().count("Registered to") == 2, 200)
        yield found[1], processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_the_cell_of_a_dead_worker_is_run_elsewhere(cluster, stub: Path, tmp_path: Path):
    address, workers = cluster
    held = stub / "hold-00-none-bow-0"
    held.touch()
    (stub / "fail-05-none-none-0").touch()
    out = tmp_path / "bench"
    options = execute.CellOptions(None, CONFIG, 1, command=COMMAND)
    with closing(run_on_cluster(CELLS[:5], options, address, out)) as running:
        outcomes = [next(running)]
        wait_for(lambda: "00-none-bow-0" in dict(started(stub)))
        dead = dict(started(stub))["00-none-bow-0"]
        (orphan,) = psutil.Process(dead).children()
        os.kill(dead, signal.SIGKILL)
        wait_for(lambda: dict(started(stub))["00-none-bow-0"] != dead)
        held.unlink()
        outcomes += running
    orphan.wait(60)
    assert dead in [worker.pid for worker in workers]
    assert {outcome.cell for outcome in outcomes} == set(CELLS[:5])
    failed = [outcome for outcome in outcomes if isinstance(outcome, execute.Failed)]
    assert [outcome.message for outcome in failed] == ["images of the moon; point the camera down."]
    assert execute.finished_cells(CELLS, out, CONFIG) == CELLS[:4]


@pytest.mark.slow
def test_leaving_stops_the_workers_runs(cluster, stub: Path, tmp_path: Path):
    address, workers = cluster
    (stub / "hold-00-none-bow-0").touch()
    options = execute.CellOptions(None, CONFIG, 1, command=COMMAND)
    with closing(run_on_cluster(CELLS[:2], options, address, tmp_path / "bench")) as running:
        next(running)
        wait_for(lambda: len(started(stub)) == 2)
    wait_for(lambda: not any(w.children() for w in workers))


@pytest.mark.slow
def test_no_scheduler_is_one_sentence(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("vslam_lab.bench.cluster._CONNECT_S", 1)
    options = execute.CellOptions(None, CONFIG, 1)
    with (
        pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:9: no scheduler answers"),
        closing(run_on_cluster(CELLS, options, "tcp://127.0.0.1:9", tmp_path)) as running,
    ):
        next(running)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "said"),
    [("foo://bar", "no scheduler answers"), ("tls://127.0.0.1:9", "Dask has no certificates")],
)
def test_an_address_that_cannot_be_used_leaves_no_client_behind(address: str, said: str):
    code = (
        "from vslam_lab.bench.cluster import run_on_cluster\n"
        "from vslam_lab.bench.execute import CellOptions\n"
        "from vslam.support.errors import InputError\n"
        "try:\n"
        f"    next(run_on_cluster([], CellOptions(None, '', 1), {address!r}, None))\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert f"--scheduler {address}: {said}" in done.stdout
    assert not done.stderr
