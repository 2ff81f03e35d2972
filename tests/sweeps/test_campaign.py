"""Campaigns: nothing is lost with a worker, and nothing is done twice."""

import json
import os
import signal
import subprocess
import sys
import time

import dask
import numpy as np
import pandas as pd
import psutil
import pytest

import jaxcrumple as jc
from jaxcrumple.run.run import start_run
from jaxcrumple.sweeps import cluster
from jaxcrumple.sweeps.campaign import run_missing
from jaxcrumple.sweeps.cluster import connected

SETTINGS = {"nodes": 60, "scheme": "explicit", "frames": 3}
RISES, LOADS = [0.0015, 0.002], [0.1, 0.15, 0.2, 0.25, 0.3, 0.35]
RUNS = jc.grid("arch", {"rise": RISES, "load": LOADS}, SETTINGS, t_end=3e-3)


def kill(client):
    """Kill a worker process as a lack of memory does."""
    process = next(iter(client.run(os.getpid).values()))
    os.kill(process, signal.SIGKILL)


def summaries(folder):
    """When the summary of each run that has one was written."""
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/summary.json")}


@pytest.fixture(scope="module")
def client():
    """Two workers of this machine."""
    with connected(None, 2) as client:
        yield client


@pytest.fixture(scope="module")
def campaign(tmp_path_factory, client):
    """A campaign of 12 runs whose first worker is killed when the third run has ended, its table, what had
    been finished then, and what the campaign told."""
    folder = tmp_path_factory.mktemp("campaign") / "runs"
    told, finished = [], {}

    def tell(name, result):
        told.append((name, result))
        if len(told) == 3:
            finished.update(summaries(folder))
            kill(client)

    table = jc.campaign(RUNS, folder, cluster=client, tell=tell)
    return folder, table, finished, told


def test_a_killed_worker_loses_nothing(campaign):
    """Every run is there, none that had ended was done again, and each was told once."""
    folder, table, finished, told = campaign
    assert list(table.index) == list(RUNS) and len(RUNS) == 12
    assert np.all(table["result"] == "success") and np.all(table["t_reached"] == 3e-3)
    assert sorted(told) == sorted((name, "success") for name in RUNS)
    assert 3 <= len(finished) < 12
    written = summaries(folder)
    assert {name: written[name] for name in finished} == finished


def test_the_runs_are_those_of_a_campaign_that_nothing_happened_to(campaign, tmp_path):
    """Bit for bit, wherever the kill came: those that were going then are among the ones after the third."""
    folder, _, _, told = campaign
    for name in [name for name, _ in told[3:7]]:
        config = RUNS[name]
        start_run(config, tmp_path / name)
        alone, run = jc.load(tmp_path / name), jc.load(folder / name)
        np.testing.assert_array_equal(alone.x, run.x)
        np.testing.assert_array_equal(alone.history, run.history)


def test_again_only_what_is_missing_is_done(campaign, client):
    folder, table, *_ = campaign
    before, (first, *_) = summaries(folder), RUNS
    (folder / first / "summary.json").write_text("{")  # damaged, so it is written again
    more = RUNS | jc.grid("arch", {"rise": [0.0025], "load": [0.1]}, SETTINGS, t_end=3e-3)
    again = jc.campaign(more, folder, cluster=client)
    after = summaries(folder)
    assert {name for name in after if before.get(name) != after[name]} == {first, "rise=0.0025,load=0.1"}
    assert len(again) == 13 and np.all(again["result"] == "success")
    np.testing.assert_array_equal(again["energy.bending"][:12], table["energy.bending"])
    one = jc.campaign({first: RUNS[first]}, folder, cluster=client)
    assert len(one) == 1
    written = pd.read_csv(folder / "campaign.csv", index_col="run")
    assert len(written) == 13
    # The options in which runs differ are columns.
    assert written.columns[:2].tolist() == again.columns[:2].tolist() == ["rise", "load"]
    for name, row in written.iterrows():
        assert name == f"rise={row['rise']:g},load={row['load']:g}"


def test_a_run_killed_before_it_was_there_is_begun_again(tmp_path):
    """All it left is the beginning of its first file."""
    name, config = next(iter(RUNS.items()))
    folder = tmp_path / name
    folder.mkdir()
    (folder / ".run.json.tmp").write_text("{")
    assert run_missing(config, folder)["result"] == "success"
    assert not (folder / ".run.json.tmp").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".precious.tmp").touch()
    with pytest.raises(jc.RunDirectoryError, match="is not empty"):
        run_missing(config, tmp_path / "other")


def test_a_folder_of_another_run_is_refused(campaign):
    folder = campaign[0]
    name = next(iter(RUNS))
    other = RUNS[name].model_copy(update={"seed": 7})
    with pytest.raises(jc.ConfigError, match=r"with seed = 0, but 'rise=0\.0015,load=0\.1' asks for 7"):
        jc.campaign({name: other}, folder)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ({}, "runs must be configurations"),
        ({"one": {"scene": "arch"}}, "'one' is a dict"),
        ({"a/b": next(iter(RUNS.values()))}, "'a/b' has a name that no folder may have"),
        ({"..": next(iter(RUNS.values()))}, "'..' has a name that no folder may have"),
        ({"campaign.csv": next(iter(RUNS.values()))}, "'campaign.csv' has a name that no folder"),
    ],
)
def test_what_is_no_campaign_is_refused(runs, message, tmp_path):
    with pytest.raises(jc.ConfigError, match=message):
        jc.campaign(runs, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(jc.RunDirectoryError, match="must exist and be a folder"):
        jc.campaign(RUNS, tmp_path / "file")


def test_a_run_that_breaks_stops_alone(tmp_path, client):
    """Something comes into the place of the last run before it begins; the next campaign does it."""
    names = list(RUNS)[:3]
    runs = {name: RUNS[name] for name in names}
    start_run(RUNS[names[0]], tmp_path / names[0])
    table = jc.campaign(runs, tmp_path, cluster=client, tell=lambda *row: (tmp_path / names[2]).touch())
    assert table["result"].tolist() == ["success", "success", "error"]
    assert "is a file" in table["message"][names[2]]
    (tmp_path / names[2]).unlink()
    assert np.all(jc.campaign(runs, tmp_path, cluster=client)["result"] == "success")


@pytest.mark.slow
def test_a_scheduler_that_is_killed_is_told(tmp_path):
    """By the command, which exits with 1; what had ended is in the table."""
    where = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    file, scheduler_file = tmp_path / "arch.toml", tmp_path / "scheduler.json"
    settings = 'scene = "arch"\nt_end = 3e-3\nsettings = {nodes = 60, scheme = "explicit"}\n'
    file.write_text(settings + "over = {load = [0.1, 0.15, 0.2, 0.25, 0.3, 0.35]}\n")
    dask = [sys.executable, "-m", "dask"]
    scheduler = subprocess.Popen([*dask, "scheduler", *where, "--scheduler-file", scheduler_file])
    worker = subprocess.Popen(
        [
            *dask,
            "worker",
            "--scheduler-file",
            scheduler_file,
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
        ],
        cwd=tmp_path,
    )
    try:
        while not scheduler_file.exists():
            time.sleep(0.1)
        address = json.loads(scheduler_file.read_text())["address"]
        words = ["campaign", str(file), "--out", str(tmp_path / "runs"), "--scheduler", address]
        program = [sys.executable, "-m", "jaxcrumple", *words]
        command = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert any(line.endswith(": success\n") for line in command.stdout)
        scheduler.kill()
        _, errors = command.communicate(timeout=200)
    finally:
        scheduler.kill()
        worker.kill()
    assert command.returncode == 1
    last = errors.splitlines()[-1]
    assert last.startswith("error: the scheduler of the worker processes is gone")
    assert "what was saved is kept in" in last and "Traceback" not in errors
    assert len(pd.read_csv(tmp_path / "runs" / "campaign.csv")) >= 1


@pytest.mark.slow
def test_the_only_worker_comes_back(monkeypatch, tmp_path):
    """However often one looks meanwhile."""
    monkeypatch.setattr(cluster, "LOOK", 0.2)
    monkeypatch.setattr(cluster, "LOOKS", 1000)
    with connected(None, 1) as client:
        jobs = cluster.run_all(client, die_once, [(str(tmp_path / "died"),)])
        assert [future.result() for _, future in jobs] == ["alive"]


def die_once(path):
    """End this process as a lack of memory does, if that has not been done."""
    if not os.path.exists(path):
        open(path, "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


@pytest.mark.slow
def test_a_worker_that_gets_no_time_for_long_is_waited_for():
    """As on a machine with too much to do: by default Dask gives up one that says nothing for a while."""
    with dask.config.set({"distributed.scheduler.worker-ttl": "1s"}), connected(None, 1) as client:
        jobs = cluster.run_all(client, sleep_well, [(12.0,)])
        assert [future.result() for _, future in jobs] == ["awake"]


def sleep_well(seconds):
    """Stop this process for some time."""
    subprocess.Popen(["sh", "-c", f"sleep {seconds}; kill -CONT {os.getpid()}"])
    os.kill(os.getpid(), signal.SIGSTOP)
    return "awake"


def test_workers_that_are_gone_for_good_end_the_wait(monkeypatch):
    """And do not leave it waiting for ever."""
    monkeypatch.setattr(cluster, "LOOK", 0.5)
    with connected(None, 1) as client:
        jobs = cluster.run_all(client, time.sleep, [(300.0,)])
        client.wait_for_workers(1)
        for process in psutil.Process().children(recursive=True):
            process.kill()
        with pytest.raises(RuntimeError, match="all worker processes are gone"):
            next(jobs)
