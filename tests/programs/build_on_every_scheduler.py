"""Build one frame set in every way there is; a program, run by the tests.

usage: python -m programs.build_on_every_scheduler FOLDER

Prints, for each build, the way and the file's SHA-256.
"""

import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from distributed import LocalCluster
from numpy.typing import NDArray

from phasemark.data import FramePlan, build_frames
from phasemark.data.frames.build_frames import FrameJob
from phasemark.data.shards.build import build
from phasemark.data.shards.remote import ProcessMaker

PLAN = FramePlan(classes=["cone", "post"], views=130, frames_per_view=2, seed=7, wall_m=4.0)


class Twice(ProcessMaker):
    """Has every shard made twice, mostly by different processes, and takes the second one."""

    def make(self, start: int, stop: int) -> Sequence[NDArray[Any]]:
        super().make(start, stop)
        return super().make(start, stop)


def main(folder: str) -> None:
    path = Path(folder) / "frames.h5"

    def say(*way: object) -> None:
        print(*way, hashlib.sha256(path.read_bytes()).hexdigest(), flush=True)

    for workers in (1, 2, 3, 8):
        with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
            for kind, scheduler in (
                ("threads", "threads"),
                ("processes", f"local:{workers}"),
                ("dask", cluster.scheduler_address),
            ):
                for shard_items in (1, 7, 64):
                    options: dict[str, Any] = {"workers": workers} if kind == "threads" else {}
                    build_frames(
                        PLAN, path, force=True, scheduler=scheduler, shard_items=shard_items, **options
                    ).close()
                    say(kind, workers, shard_items)
    job = FrameJob(PLAN)
    for shard_items in (1, 7, 64):
        maker = Twice(job, 2)
        try:
            build(job, path, force=True, maker=maker, shard_items=shard_items)
        finally:
            maker.close()
        say("twice", 2, shard_items)


if __name__ == "__main__":
    main(sys.argv[1])
