"""Build a frame set on a local Dask cluster whose workers are killed every so often; a program, run by the tests.

usage: dask_build.py OUT VIEWS SECONDS   (SECONDS between kills; 0: none)
"""

import os
import signal
import sys
import threading
from contextlib import suppress

from distributed import LocalCluster

from phasemark.data import FramePlan, build_frames


def main(out, views, seconds):
    plan = FramePlan(classes=["cone", "post"], views=views, frames_per_view=2, seed=7, wall_m=4.0)
    ended = threading.Event()
    killed = 0
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill():
            nonlocal killed
            turn = 0
            while not ended.wait(seconds):
                workers = list(cluster.workers.values())
                with suppress(Exception):  # it may be between two lives
                    os.kill(workers[turn % len(workers)].pid, signal.SIGKILL)
                    killed += 1
                turn += 1

        if seconds:
            threading.Thread(target=kill, daemon=True).start()
        build_frames(plan, out, scheduler=cluster.scheduler_address, shard_items=max(1, views // 60)).close()
        ended.set()
    sys.stdout.write(f"{killed}\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
