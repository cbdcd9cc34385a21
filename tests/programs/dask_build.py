"""Build a frame set on a Dask cluster whose workers are killed every so often; a program, run by the tests.

usage: python -m programs.dask_build OUT VIEWS SECONDS   (SECONDS between kills; 0: none)

Two workers come when the build says that it waits for one, and another for each that is killed. Prints how many were.
"""

import subprocess
import sys
import threading
import warnings
from typing import Any

from distributed import LocalCluster

from phasemark.data import FramePlan, build_frames
from phasemark.data.shards import remote


def worker(address: str) -> subprocess.Popen[bytes]:
    """Start a worker that nobody looks after; the scheduler knows it by its process id.

    It loads what it will need before it offers itself: killed every other second, it would do nothing else.
    """
    program = (
        "import asyncio, os, sys; from distributed import Worker\n"
        "from phasemark.data import FramePlan; from phasemark.data.frames.build_frames import FrameJob\n"
        "FrameJob(FramePlan(classes=['cone'], views=1)).make(0, 0, 1)\n"
        "async def main(): await (await Worker(sys.argv[1], nthreads=1, name=os.getpid())).finished()\n"
        "asyncio.run(main())"
    )
    return subprocess.Popen([sys.executable, "-c", program, address], stderr=subprocess.DEVNULL)


def main(out: str, views: int, seconds: float) -> None:
    plan = FramePlan(classes=["cone", "post"], views=views, frames_per_view=2, seed=7, wall_m=4.0)
    ended, killed = threading.Event(), 0
    told: list[str] = []
    workers: list[subprocess.Popen[bytes]] = []
    remote.PATIENCE_SECONDS = 1
    with LocalCluster(n_workers=0, dashboard_address=":0") as cluster:  # type: ignore[no-untyped-call]

        def begin(message: object, *_: Any, **__: Any) -> None:
            told.append(str(message))
            workers.extend(worker(cluster.scheduler_address) for _ in range(2))

        def kill() -> None:
            nonlocal killed
            while not ended.wait(seconds):
                known = {state.name for state in cluster.scheduler.workers.values()}
                at_work = [each for each in workers if each.pid in known]
                if at_work:  # the one that has lived longest
                    at_work[0].kill()
                    at_work[0].wait()
                    workers.remove(at_work[0])
                    workers.append(worker(cluster.scheduler_address))
                    killed += 1

        warnings.showwarning = begin
        killer = threading.Thread(target=kill)
        if seconds:
            killer.start()
        build_frames(plan, out, scheduler=cluster.scheduler_address, shard_items=max(1, views // 60)).close()
        ended.set()
        if seconds:
            killer.join()
        for each in workers:
            each.kill()
            each.wait()
        assert told == [f"no worker is connected to {cluster.scheduler_address}: waiting for one"]
    sys.stdout.write(f"{killed}\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
