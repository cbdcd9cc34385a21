"""The same bytes from clusters, even if workers die; what was begun is continued; and other versions are refused."""

import json

import pytest
from builders import run_program

from phasemark import OutputExistsError, UsageError
from phasemark.data import FramePlan, build_frames
from phasemark.data.frames.build_frames import FrameJob
from phasemark.data.shards.remote import make_bytes, open_maker

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
    views = 30_000
    build_frames(PLAN.model_copy(update={"views": views}), tmp_path / "reference.h5").close()
    killed = dask_build(tmp_path / "frames.h5", views, 2)
    assert killed >= 3
    assert (tmp_path / "frames.h5").read_bytes() == (tmp_path / "reference.h5").read_bytes()


def test_a_worker_that_would_make_other_bytes_is_refused():
    class Elsewhere(FrameJob):
        def identity(self):
            return {**super().identity(), "versions": {"numpy": "0.1"}}

    job = Elsewhere(PLAN)
    with pytest.raises(UsageError, match=r"a worker would make other bytes \(versions\.numpy: "):
        make_bytes(json.dumps([job.maker, job.spec()]), json.dumps(job.identity()), 0, 1)


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("phasemark.data.shards.remote.CONNECT_SECONDS", 0.2)
    with pytest.raises(UsageError, match=r"^no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        open_maker("tcp://127.0.0.1:9", FrameJob(FramePlan(classes=["cone"], views=1)))


@pytest.mark.parametrize(("views", "n"), [(40, 1), pytest.param(1500, 200, marks=pytest.mark.soak)])
def test_a_build_killed_at_a_random_moment_resumes_to_the_same_bytes(tmp_path, views, n):
    done = run_program("random_kills", tmp_path, views, n, 11)
    assert sum(map(int, done.split()[-3:])) == n
    print(f"before, during and after the file was made: {done.split()[-3:]}")


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
