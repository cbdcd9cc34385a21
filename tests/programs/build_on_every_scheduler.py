"""Build one frame set in threads and on Dask clusters; a program, run by the tests.

usage: python -m programs.build_on_every_scheduler FOLDER

Prints, for each build, the way and the file's SHA-256.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

from distributed import LocalCluster

from phasemark.data import FramePlan, build_frames

PLAN = FramePlan(classes=["cone", "post"], views=130, frames_per_view=2, seed=7, wall_m=4.0)


def main(folder: str) -> None:
    path = Path(folder) / "frames.h5"

    def say(*way: object) -> None:
        print(*way, hashlib.sha256(path.read_bytes()).hexdigest(), flush=True)

    for workers in (1, 2, 3, 8):
        with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
            for kind, scheduler in (("threads", "threads"), ("dask", cluster.scheduler_address)):
                for shard_items in (1, 7, 64):
                    options: dict[str, Any] = {"workers": workers} if kind == "threads" else {}
                    build_frames(
                        PLAN, path, force=True, scheduler=scheduler, shard_items=shard_items, **options
                    ).close()
                    say(kind, workers, shard_items)


if __name__ == "__main__":
    main(sys.argv[1])
