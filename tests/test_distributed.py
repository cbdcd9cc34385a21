"""The same bytes from worker processes and clusters, even if some die; and no process outlives the command."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from builders import run_program

from phasemark import OutputExistsError, UsageError
from phasemark.data import FramePlan, build_frames
from phasemark.data.frames.build_frames import FrameJob
from phasemark.data.shards.build import build, manifest_path, partial_path
from phasemark.data.shards.remote import ProcessMaker

PROGRAM = [sys.executable, "-c", "import sys; from phasemark.cli import main; sys.exit(main())"]
PLAN = FramePlan(classes=["cone", "post"], views=40, frames_per_view=2, seed=7, wall_m=4.0)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.h5"
    build_frames(PLAN, path).close()
    return path.read_bytes()


def dask_build(out, views, seconds):
    return int(run_program("dask_build", out, views, seconds).split()[-1])


def test_a_dask_cluster_makes_the_same_bytes(reference, tmp_path):
    pytest.importorskip("distributed")
    dask_build(tmp_path / "frames.h5", 40, 0)
    assert (tmp_path / "frames.h5").read_bytes() == reference


@pytest.mark.soak
def test_a_dask_cluster_whose_workers_are_killed_every_2_s_makes_the_same_bytes(tmp_path):
    views = 12_000
    build_frames(PLAN.model_copy(update={"views": views}), tmp_path / "reference.h5").close()
    killed = dask_build(tmp_path / "frames.h5", views, 2)
    assert killed >= 3
    assert (tmp_path / "frames.h5").read_bytes() == (tmp_path / "reference.h5").read_bytes()


def test_every_shard_made_twice_gives_the_same_bytes(reference, tmp_path):
    class Twice:
        def __init__(self, job):
            self.job = job

        def make(self, start, stop):
            first, second = self.job.make(0, start, stop), self.job.make(0, start, stop)
            assert all(a.tobytes() == b.tobytes() for a, b in zip(first, second, strict=True))
            return second

        def concurrency(self):
            return 3

        def close(self):
            pass

    job = FrameJob(PLAN)
    build(job, tmp_path / "frames.h5", maker=Twice(job), shard_items=7)
    assert (tmp_path / "frames.h5").read_bytes() == reference


def test_a_worker_process_that_dies_is_replaced(reference, tmp_path):
    job = FrameJob(PLAN)
    maker = ProcessMaker(job, 2)
    ended = threading.Event()

    def kill():
        while not ended.wait(1.0):
            for worker in list(maker._all)[:1]:
                os.kill(worker._child.pid, signal.SIGKILL)
                return

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        build(job, tmp_path / "frames.h5", maker=maker, shard_items=2)
    finally:
        ended.set()
        killer.join()
        maker.close()
    assert (tmp_path / "frames.h5").read_bytes() == reference


def test_a_script_without_a_main_guard_may_have_worker_processes(reference, tmp_path):
    """The standard library's pools import an unguarded script again in each worker, and end with BrokenProcessPool."""
    script = tmp_path / "script.py"
    script.write_text(
        "from phasemark.data import FramePlan, build_frames\n"
        f"plan = FramePlan(**{PLAN.model_dump(exclude_unset=True)!r})\n"
        "build_frames(plan, 'frames.h5', scheduler='local:2', shard_items=7).close()\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "frames.h5").read_bytes() == reference


def test_a_shard_of_one_worker_that_dies_is_the_only_one_made_again(tmp_path):
    maker = ProcessMaker(FrameJob(PLAN), 2)
    made = []
    try:
        threads = [threading.Thread(target=lambda k=k: made.append(maker.make(k, k + 1))) for k in range(2)]
        for thread in threads:
            thread.start()
        while len(maker._all) < 2:
            time.sleep(0.01)
        first, second = list(maker._all)
        os.kill(first._child.pid, signal.SIGKILL)
        for thread in threads:
            thread.join()
        assert len(made) == 2
        assert second in maker._all
        assert second._child.poll() is None
    finally:
        maker.close()


def test_a_worker_that_would_make_other_bytes_is_refused():
    class Elsewhere(FrameJob):
        def identity(self):
            return {**super().identity(), "versions": {"numpy": "0.1"}}

    maker = ProcessMaker(Elsewhere(PLAN), 1)
    try:
        with pytest.raises(UsageError, match=r"a worker would make other bytes \(versions\.numpy: "):
            maker.make(0, 1)
    finally:
        maker.close()


def test_a_scheduler_that_does_not_answer_is_named():
    pytest.importorskip("distributed")
    program = (
        "from phasemark.data.shards.remote import open_maker\n"
        "from phasemark.data.frames.build_frames import FrameJob\n"
        "from phasemark.data import FramePlan\n"
        "import phasemark.data.shards.remote as remote\n"
        "remote.CONNECT_SECONDS = 1\n"
        "open_maker('tcp://127.0.0.1:9', FrameJob(FramePlan(classes=['cone'], views=1)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "UsageError: no Dask scheduler answers at tcp://127.0.0.1:9" in done.stderr.splitlines()[-1]


def children_of(pid):
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(line) for line in listed.stdout.split()]


def is_alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_process_outlives_the_command(tmp_path, number):
    plan = tmp_path / "plan.toml"
    plan.write_text('views = 20000\nclasses = ["cone"]\n')
    out = tmp_path / "frames.h5"
    command = ["frames", "build", str(plan), "-o", str(out), "--scheduler", "local:2", "--shard-size", "20"]
    with subprocess.Popen([*PROGRAM, *command], stderr=subprocess.PIPE) as child:
        end = time.monotonic() + 30
        while not (manifest_path(out).exists() and manifest_path(out).read_bytes().count(b"\n") > 2):
            assert time.monotonic() < end
            assert child.poll() is None, child.stderr.read()
            time.sleep(0.05)
        workers = children_of(child.pid)
        assert len(workers) == 2
        child.send_signal(number)
        child.wait(20)
    assert child.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    end = time.monotonic() + 20  # a worker notices when it has finished its shard
    while any(map(is_alive, workers)):
        assert time.monotonic() < end, "a worker process is left"
        time.sleep(0.05)
    assert not out.exists()
    assert partial_path(out).exists()


@pytest.mark.parametrize(("views", "n"), [(40, 2), pytest.param(1500, 200, marks=pytest.mark.soak)])
def test_a_build_killed_at_a_random_moment_resumes_to_the_same_bytes(tmp_path, views, n):
    done = run_program("random_kills", tmp_path, views, n, 11)
    assert sum(map(int, done.split()[-3:])) == n
    print(f"before, during and after the file was made: {done.split()[-3:]}")


@pytest.mark.soak
def test_threads_processes_and_dask_make_one_file_whatever_the_workers_and_shards(tmp_path):
    pytest.importorskip("distributed")
    lines = run_program("build_on_every_scheduler", tmp_path).splitlines()
    made = [line.split() for line in lines if line.split()[0] in ("threads", "processes", "dask", "twice")]
    assert len(made) == 3 * 4 * 3 + 3
    assert len({line[-1] for line in made}) == 1


def test_a_changed_mesh_file_is_noticed_when_resuming(tmp_path):
    from phasemark.landmarks import build_mesh, catalog, export_mesh

    mesh = tmp_path / "part.stl"
    mesh.write_bytes(export_mesh(build_mesh(catalog()["cone"]), "stl"))
    plan = FramePlan(meshes=[{"name": "part", "path": str(mesh), "unit": "m"}], views=6, seed=1)
    out = tmp_path / "frames.h5"

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_frames(plan, out, workers=1, shard_items=2, progress=interrupt)
    mesh.write_bytes(export_mesh(build_mesh(catalog()["post"]), "stl"))
    with pytest.raises(OutputExistsError, match=r"was begun with another plan \(mesh_sha256\.part: "):
        build_frames(plan, out, resume=True)
