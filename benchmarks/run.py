"""Measure speed and accuracy on this machine: ``python benchmarks/run.py [SECTION …]``.

Prints tables in Markdown and writes the numbers to out/bench.json. Times are medians of several runs; machines are
noisy, so compare ratios within one run. Open3D stands in as a peer where it can be imported (it needs libusb-1.0-0,
libgl1, libgomp1 and libx11-6 of Debian); without it the rest runs all the same.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from direct import direct
from matching import matching
from mounting import design, mounting
from policy import policy
from regions import regions
from scenes import scenes
from tolerance import tolerance

from phasemark.data import BankPlan, build_bank, open_bank
from phasemark.landmarks import build_mesh, catalog
from phasemark.matcher import FilteredFrames, Matcher, kalman_filter, phasor_mean
from phasemark.matcher.accuracy import TrialSetup
from phasemark.matcher.accuracy.trials import noisy_frames
from phasemark.matcher.nearest.nearest_matcher import NearestMatcher
from phasemark.matcher.nearest.search import ExactSearch, nearest_search
from phasemark.matcher.nearest.templates import Observation
from phasemark.render import Background, PhasorImages, Renderer, Sensor, Views, camera_unit, capture, preset

ROOT = Path(__file__).resolve().parent.parent
SENSOR = preset("pmd-16x16")
WRONG_IN_THE_REFERENCE = (5, 4, 6)  # frame, row, column: tests/test_reference_frames.py has the proof
SEED = 2005
Table = dict[str, Any]


def seconds_of(work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the time of a piece of work by a clock."""
    started = clock()
    work()
    return clock() - started


def median_seconds(work: Callable[[], object], runs: int = 5) -> float:
    """Return the median time of a piece of work, after one run that is not counted."""
    work()
    return statistics.median(seconds_of(work) for _ in range(runs))


def processor_seconds(work: Callable[[], object], runs: int = 5) -> float:
    """Return the median processor time of a piece of work, all threads together: other programs hardly change it."""
    return statistics.median(seconds_of(work, time.process_time) for _ in range(runs))


def measured(code: str, *arguments: object) -> list[float]:
    """Run a program in a process of its own; return the numbers in its last line and its peak memory in MiB."""
    code = (
        f"import os, re, sys, time; from pathlib import Path; {code};"
        # what getrusage reports is never below the parent's memory at the fork
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text()); print(int(peak[1]) / 1024)"
    )
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(number) for number in done.stdout.splitlines()[-1].split()]


def random_views(n: int, seed: int = SEED) -> Views:
    """Return views like those of the reference: D 0.75 to 2 m, any δ, bearing ± 3°, height ± 5 cm."""
    rng = np.random.default_rng(seed)
    return Views(
        rng.uniform(0.75, 2.0, n),
        rng.uniform(0, np.pi, n),
        np.radians(rng.uniform(-3, 3, n)),
        rng.uniform(-0.05, 0.05, n),
    )


def reference() -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray]:
    """Return cases, phasors and coverages of the reference frames."""
    with np.load(ROOT / "tests" / "golden" / "reference.npz") as file:
        return json.loads(str(file["cases"])), file["phasor"], file["coverage"]


def render_case(renderer: Renderer, case: dict[str, Any]) -> Any:
    """Render the view of one reference frame."""
    view = {key: case.get(key, 0.0) for key in ("distance_m", "delta_rad", "bearing_rad", "height_m")}
    return renderer.render(**view, background=Background(wall_m=case.get("wall_m"), floor_m=case.get("floor_m")))


def accuracy() -> Table:
    """Compare with frames integrated from the true solids."""
    cases, phasor, coverage = reference()
    renderers = {name: Renderer(build_mesh(spec), SENSOR) for name, spec in catalog().items()}
    rows = []
    for k, case in enumerate(cases):
        image = render_case(renderers[case["cls"]], case)
        compared = np.ones((16, 16), bool)
        if k == WRONG_IN_THE_REFERENCE[0]:
            compared[WRONG_IN_THE_REFERENCE[1:]] = False
        rows.append(
            {
                "frame": k,
                "class": case["cls"],
                "D (m)": f"{case['distance_m']:.3f}",
                "wall": "yes" if "wall_m" in case else "no",
                "floor": "yes" if "floor_m" in case else "no",
                "ε": float(f"{(np.abs(image.phasor[0] - phasor[k])[compared].max() / np.abs(phasor[k]).max()):.2g}"),
                "coverage error": float(f"{np.abs(image.coverage[0] - coverage[k])[compared].max():.2g}"),
            }
        )
    return {"rows": rows, "worst ε": max(row["ε"] for row in rows)}


def rendering() -> Table:
    """Time batches of 1000 views of each class, and single views; say where the time goes."""
    views = random_views(1000)
    sizes = [
        seconds_per_view(
            Renderer(build_mesh(catalog()["cylinder"]), SENSOR.with_(rows=pixels, cols=pixels)), views[:200], 1
        )
        for pixels in (16, 64)
    ]
    return {
        "rows": [rendering_of(name, views) for name in catalog()],
        "time of 64 × 64 over 16 × 16 pixels": round(sizes[1] / sizes[0], 2),
    }


def seconds_per_view(renderer: Renderer, views: Views, workers: int, background: Background | None = None) -> float:
    """Return the median time of a view in a batch."""
    work = partial(renderer.render_views, views, workers=workers, background=background)
    return median_seconds(work) / len(views)


def rendering_of(name: str, views: Views) -> dict[str, Any]:
    """Time one class."""
    renderer = Renderer(build_mesh(catalog()[name]), SENSOR)
    speed = [1 / seconds_per_view(renderer, views, workers) for workers in (1, 2)]
    single = median_seconds(lambda: [renderer.render_views(views[k : k + 1]) for k in range(100)]) / 100
    cast, spent, rays = renderer._integral.intersector.first_face, 0.0, 0

    def timed(origins: Any, directions: Any) -> Any:
        nonlocal spent, rays
        started = time.perf_counter()
        faces = cast(origins, directions)
        spent += time.perf_counter() - started
        rays += len(origins)
        return faces

    renderer._integral.intersector.first_face = timed  # type: ignore[method-assign]
    started = time.perf_counter()
    renderer.render_views(views)
    total = time.perf_counter() - started
    return {
        "class": name,
        "faces": len(renderer.topology.faces),
        "frames/s, 1 thread": round(speed[0]),
        "frames/s, 2 threads": round(speed[1]),
        "single view (ms)": round(1e3 * single, 2),
        "rays/frame": round(rays / len(views)),
        "ray casting's share of the time": f"{100 * spent / total:.0f} %",
        "ray casting alone (M rays/s)": round(rays / spent / 1e6, 1),
    }


def lenses() -> Table:
    """Time views behind a lens with distortion beside those of the same pixels behind an ideal one, in turn."""
    rows = []
    for size, focal, n in (((16, 16), 41.0, 64), ((224, 171), 200.0, 4)):
        matrix = np.array([[focal, 0, size[0] / 2 - 0.5], [0, focal, size[1] / 2 - 0.5], [0, 0, 1]])
        lens = Sensor.from_opencv(matrix, (-0.31, 0.12, 0.0012, -0.0008, -0.02), size=size)
        views = random_views(n)
        for name in catalog():
            for background in (None, Background(wall_m=4.0, floor_m=0.5)):
                pair = [Renderer(build_mesh(catalog()[name]), one) for one in (lens, lens.with_(lens=None))]
                times: list[list[float]] = [[], []]
                for run in range(8):
                    for spent, renderer in zip(times, pair, strict=True):
                        seconds = processor_seconds(partial(renderer.render_views, views, background=background), 1)
                        spent += [seconds] if run else []  # the first one fills the tables
                with_lens, without = (statistics.median(spent) / n for spent in times)
                rows.append(
                    {
                        "pixels": f"{size[0]} × {size[1]}",
                        "class": name,
                        "background": "none" if background is None else "wall and floor",
                        "a view, ideal lens (ms)": round(1e3 * without, 2),
                        "a view, distortion (ms)": round(1e3 * with_lens, 2),
                        "frames/s with over without": round(without / with_lens, 2),
                    }
                )
    return {"rows": rows, "least ratio": min(row["frames/s with over without"] for row in rows)}


def banks() -> Table:
    """Time the default banks; memory is the peak of a process that does nothing else."""
    code = (
        "from phasemark.data import BankPlan, build_bank;"
        "s = time.perf_counter(); build_bank(BankPlan(layout=sys.argv[1]), sys.argv[2]).close();"
        "print(time.perf_counter() - s, end=' ')"
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for layout, images in (("factored", 141 * 180 + 4 * 141), ("full", 4 * 141 * 180)):
            path = Path(folder) / f"{layout}.h5"
            seconds, mebibytes = measured(code, layout, path)
            rows.append(
                {
                    "bank": layout,
                    "images": images,
                    "seconds": round(seconds, 1),
                    "images/s": round(images / seconds),
                    "file (MB)": round(path.stat().st_size / 1e6, 1),
                    "peak memory (MiB)": round(mebibytes),
                }
            )
    return {"rows": rows}


def million() -> Table:
    """Build a million noisy frames with their truth, and say how much of the time is not spent on making them."""
    code = (
        "from phasemark.data import FramePlan, build_frames; from phasemark.data.frames.build_frames import FrameJob;"
        "from phasemark.data.shards.build import SHARD_BYTES, make_shard, processors, run_tasks;"
        "plan = FramePlan(views=250_000, frames_per_view=4, seed=7, wall_m=4.0);"
        "job = FrameJob(plan); size = job.lay_out()[0].size; items = max(1, SHARD_BYTES * plan.views // size);"
        "make_shard(job, 0, items);"
        "s = time.perf_counter(); c = sum(os.times()[:4]);"
        "build_frames(plan, sys.argv[1]).close();"
        "seconds = time.perf_counter() - s; busy = sum(os.times()[:4]) - c;"
        # every tenth shard again, with nothing written
        "some = range(0, plan.views - items, 10 * items); s = time.perf_counter();"
        "made = list(run_tasks(lambda k: len(make_shard(job, k, k + items)), some, processors()));"
        "making = (time.perf_counter() - s) * plan.views / (len(some) * items);"
        "print(seconds, busy, making, end=' ')"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.h5"
        seconds, busy, making, mebibytes = measured(code, path)
        row = {
            "frames": 1_000_000,
            "seconds": round(seconds),
            "processor seconds": round(busy),
            "frames/s": round(1e6 / seconds),
            "share of writing": f"{100 * max(0.0, 1 - making / seconds):.0f} %",
            "file (GB)": round(path.stat().st_size / 1e9, 2),
            "peak memory (MiB)": round(mebibytes),
        }
    return {"rows": [row]}


def sweep() -> Table:
    """Run the shipped sweep `paper`, 900 000 frames and their matches, with its report."""
    code = (
        "from phasemark.cli import main;"
        "main(['sweep', 'run', 'paper', '--trials', '2', '-o', sys.argv[1] + '/warm']);"
        "s = time.perf_counter(); c = sum(os.times()[:4]);"
        "assert main(['sweep', 'run', 'paper', '-o', sys.argv[1] + '/paper']) == 0;"
        "seconds = time.perf_counter() - s; busy = sum(os.times()[:4]) - c;"
        "print(seconds, busy, end=' ')"
    )
    with tempfile.TemporaryDirectory() as folder:
        seconds, busy, mebibytes = measured(code, folder)
    row = {
        "sweep": "paper",
        "frames": 900_000,
        "seconds": round(seconds),
        "processor seconds": round(busy),
        "peak memory (MiB)": round(mebibytes),
    }
    return {"rows": [row]}


def chain() -> Table:
    """Time what comes after rendering: capture, filters, matching."""
    image = Renderer(build_mesh(catalog()["cone"]), SENSOR).render(np.full(40, 1.0), background=Background(wall_m=3.0))
    rng = np.random.default_rng(SEED)
    frames = capture(image, SENSOR, rng=rng, n_frames=50)
    count = len(frames) * frames.n_frames
    rows = [
        ("capture: shot noise, two taps × four phases", count, lambda: capture(image, SENSOR, rng=rng, n_frames=50)),
        ("Kalman filter", count, lambda: kalman_filter(frames)),
        ("mean phasor", count, lambda: phasor_mean(frames)),
    ]
    with tempfile.TemporaryDirectory() as folder:
        bank = build_bank(BankPlan(), Path(folder) / "bank.h5")
        with open_bank(bank.path) as opened:
            matcher = Matcher(opened, background=Background(wall_m=3.0))
            plain_images = NearestMatcher(opened).pose
            one = kalman_filter(frames)
            many = one[np.tile(np.arange(len(one)), 10)]
            plain, several = Matcher(opened), random_frames(2000)
            seen = Observation.from_frames(several, SENSOR.lower_rows)
            pruned = nearest_search(plain_images, opened.distance_m, opened.delta_rad)
            exact = ExactSearch(plain_images, len(plain_images))
            rows += [
                ("nearest of 25 380 images, exact", 200, lambda: exact.nearest(seen[:200])),
                ("nearest of 25 380 images, pruned", len(several), lambda: pruned.nearest(seen)),
                ("match, nearest of 25 380 + 564 images", len(several), lambda: plain.match(several)),
                ("the same before a wall", len(many), lambda: matcher.match(many)),
            ]
            free, wall = ("distance_m", "delta_rad", "bearing_rad"), Background(wall_m=3.0)
            fixed = free[:2]
            likely = [
                ("most likely D, δ on ranges", Matcher(opened, "refine", free=fixed), several[:500]),
                ("on phasors", Matcher(opened, "refine", free=fixed, on="phasors"), several[:100]),
                ("bearing near 0, the default", Matcher(opened, "refine"), several[:100]),
                ("and bearing, on ranges", Matcher(opened, "refine", free=free), several[:100]),
                ("D, δ before a wall", Matcher(opened, "refine", free=fixed, background=wall), many[:100]),
                ("and bearing, before a wall", Matcher(opened, "refine", free=free, background=wall), many[:100]),
                ("D, δ and the wall", Matcher(opened, "refine", free=fixed, background="auto"), many[:40]),
            ]
            rows += [(name, len(some), partial(likeliest.match, some)) for name, likeliest, some in likely]
            measured = [(name, n / median_seconds(work), n / processor_seconds(work)) for name, n, work in rows]
        bank.close()
    return {
        "rows": [
            {"stage": name, "frames/s": round(speed), "frames per processor second": round(busy)}
            for name, speed, busy in measured
        ]
    }


def random_frames(n: int) -> FilteredFrames:
    """Return frames of random views straight ahead, the cone's, each the mean of 50."""
    setup, rng = TrialSetup(distance_m=(0.75, 2.1)), np.random.default_rng(SEED)
    renderer = Renderer(build_mesh(catalog()["cone"]), SENSOR, albedo=0.8)
    return noisy_frames(renderer, SENSOR, setup.views(n, rng, np.pi), setup, rng)


def capturing() -> Table:
    """Time the sensor's chain, beside the same chain written plainly in NumPy."""
    rng = np.random.default_rng(SEED)
    every = preset("pmd-16x16-wiggle")
    cases = (
        ("shot noise", SENSOR),
        ("shot, ambient, read noise", SENSOR.with_(ambient_e=20_000, read_noise_e=40)),
        ("every term", every),
    )
    rows = []
    for title, sensor in cases:
        renderer = Renderer(build_mesh(catalog()["cone"]), sensor)
        image = renderer.render(np.full(40, 1.0), background=Background(wall_m=3.0))
        count, speeds = len(image) * 50, {}
        for workers in (1, 2):
            speeds[workers] = count / median_seconds(
                lambda n=workers, i=image, s=sensor: capture(i, s, rng=rng, n_frames=50, workers=n)
            )
        plain = count / median_seconds(lambda i=image, s=sensor: plain_capture(i, s, rng, 50))
        rows.append(
            {
                "terms": title,
                "frames/s, one thread": round(speeds[1]),
                "frames/s, two threads": round(speeds[2]),
                "plain NumPy, frames/s": round(plain),
                "two threads over NumPy": round(speeds[2] / plain, 1),
            }
        )
    return {"rows": rows}


def plain_capture(image: PhasorImages, sensor: Sensor, rng: np.random.Generator, n_frames: int) -> np.ndarray:
    """Return ranges by the chain of PHYSICS section 4, each term one NumPy expression, one view at a time."""
    unit = camera_unit(sensor)
    kernel = (1 - sensor.blur_share - sensor.veil_share) * np.eye(sensor.rows * sensor.cols)
    row, col = np.divmod(np.arange(sensor.rows * sensor.cols), sensor.cols)
    for share, sigma in ((sensor.blur_share, sensor.blur_px), (sensor.veil_share, sensor.veil_px)):
        square = np.subtract.outer(row, row) ** 2 + np.subtract.outer(col, col) ** 2
        weight = np.exp(-square / (2 * sigma**2))
        kernel += share * weight / weight.sum(axis=0)
    harmonics = ((1, 1.0, 0.0), *sensor.correlation_harmonics)
    tau = np.arange(4)[:, None, None, None] * np.pi / 2
    sign = np.array([1.0, -1.0])[:, None, None]
    shape = (sensor.rows, sensor.cols)
    ranges = np.empty((len(image), n_frames, *shape))
    for view in range(len(image)):
        wave = np.zeros((4, 2, *shape))
        for k, a, theta in harmonics:
            s = (kernel @ image.harmonic(k)[view].ravel()).reshape(shape)
            wave += (a * s * np.exp(1j * (k * (tau + unit.delay_rad) + theta))).real
        intensity = (kernel @ image.intensity[view].ravel()).reshape(shape)
        mean = 0.5 * (sensor.signal_e * intensity + sensor.ambient_e)
        mean = np.maximum(mean + 0.5 * sign * sensor.contrast * sensor.signal_e * wave, 0)
        taps = rng.poisson(mean * unit.response + unit.dark_e, (n_frames, 4, 2, *shape)).astype(float)
        saturated = np.zeros((n_frames, *shape), bool)
        if sensor.full_well_e is not None:
            saturated |= (taps >= sensor.full_well_e).any(axis=(1, 2))
            taps = np.minimum(taps, sensor.full_well_e)
        if sensor.read_noise_e:
            taps += sensor.read_noise_e * rng.standard_normal(taps.shape)
        if sensor.adc_bits is not None:
            codes = np.clip(np.rint(taps * sensor.gain + sensor.black_level), 0, 2**sensor.adc_bits - 1)
            saturated |= (codes == 2**sensor.adc_bits - 1).any(axis=(1, 2))
            taps = (codes - sensor.black_level) / sensor.gain
        d = taps[:, :, 0] - taps[:, :, 1]
        amplitude = 0.5 * np.hypot(d[:, 3] - d[:, 1], d[:, 0] - d[:, 2])
        variance = np.maximum(taps.sum(axis=(1, 2)) / 4, 0) + sensor.read_variance_e2
        valid = amplitude * (sensor.max_phase_std_rad or np.inf) >= np.sqrt(variance / 2)
        phase = np.arctan2(d[:, 3] - d[:, 1], d[:, 0] - d[:, 2]) % (2 * np.pi)
        valid &= ~(saturated | unit.dead | unit.hot)
        ranges[view] = np.where(valid, phase * sensor.metres_per_radian, np.nan)
    return ranges


def peer() -> Table:
    """Compare with supersampling on Open3D's RaycastingScene, on a grid and jittered, at the same error."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        return {
            "rows": [],
            "note": f"Open3D cannot be imported here ({error}); it needs libusb-1.0-0, libgl1, libgomp1",
        }
    return {"rows": [row for k in (0, 8) for row in peer_on(k, open3d.t.geometry.RaycastingScene())]}


def peer_on(k: int, scene: Any) -> list[dict[str, Any]]:
    """Compare on one reference frame; the error of jitter follows a power law, which is extrapolated to ours."""
    cases, phasor, _ = reference()
    case, truth, brightest = cases[k], phasor[k], np.abs(phasor[k]).max()
    mesh = build_mesh(catalog()[case["cls"]])
    scene.add_triangles(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    renderer = Renderer(mesh, SENSOR)
    our_error = np.abs(render_case(renderer, case).phasor[0] - truth).max() / brightest
    views = Views.broadcast(
        np.full(1000, case["distance_m"]), case["delta_rad"], case.get("bearing_rad", 0), case.get("height_m", 0)
    )
    background = Background(wall_m=case.get("wall_m"), floor_m=case.get("floor_m"))
    ours = seconds_per_view(renderer, views, 2, background)
    measured = []
    for method in ("grid", "jitter"):
        for density in (16, 32, 64, 128, 256):
            times, errors = [], []
            for run in range(1 if density == 256 else 3):
                rng = np.random.default_rng([SEED, run]) if method == "jitter" else None
                started = time.perf_counter()
                image = supersampled(scene, case, density, rng)
                times.append(time.perf_counter() - started)
                errors.append(np.abs(image - truth).max() / brightest)
            measured.append((method, density, statistics.median(times), statistics.median(errors)))
    jitter = np.array([row[2:] for row in measured if row[0] == "jitter"])
    slope, offset = np.polyfit(np.log(jitter[:, 1]), np.log(jitter[:, 0]), 1)
    needed = math.exp(offset + slope * math.log(our_error))
    return [
        {
            "frame": k,
            "method": method,
            "rays a pixel": rays,
            "seconds/frame": float(f"{seconds:.3g}"),
            "ε": float(f"{error:.2g}"),
            "time over ours": round(seconds / ours),
        }
        for method, rays, seconds, error in (
            *((f"{method} (Open3D, 2 threads)", f"{density}²", *rest) for method, density, *rest in measured),
            ("jitter, extrapolated to our ε", "", needed, our_error),
            ("phasemark, 2 threads", "7 on average", ours, our_error),
        )
    ]


def supersampled(scene: Any, case: dict[str, Any], density: int, rng: np.random.Generator | None) -> np.ndarray:
    """Return the phasors of one frame from density² rays a pixel, cast row by row by Open3D; no `rng`: on a grid."""
    views = Views.broadcast(
        case["distance_m"], case["delta_rad"], case.get("bearing_rad", 0.0), case.get("height_m", 0.0)
    )
    rotation, _ = views.landmark2cam()
    turn, lens = rotation[0].astype(np.float32), views.lens_in_landmark()[0].astype(np.float32)
    tan_h, tan_v = SENSOR.tan_half_angles
    cos_b, sin_b = math.cos(views.bearing_rad[0]), math.sin(views.bearing_rad[0])
    n = 16 * density
    cell = np.arange(n, dtype=np.float32)
    result = np.empty((16, 16), complex)
    rays = np.empty((density, n, 6), np.float32)
    rays[..., :3] = lens
    for row in range(16):
        place_u, place_v = (0.5, 0.5) if rng is None else rng.random((2, density, n), np.float32)
        u = (cell + place_u) / density
        v = row + (cell[:density, None] + place_v) / density
        direction = np.empty((density, n, 3), np.float32)
        direction[..., 0] = 1.0
        direction[..., 1] = tan_h * (1 - u / 8)
        direction[..., 2] = tan_v * (1 - v / 8)
        length = np.sqrt(np.einsum("ijk,ijk->ij", direction, direction))
        rays[..., 3:] = direction @ turn
        hit = scene.cast_rays(rays, nthreads=2)
        t = hit["t_hit"].numpy()
        facing = np.abs(np.einsum("ijk,ijk->ij", hit["primitive_normals"].numpy(), rays[..., 3:]))
        albedo = np.float32(0.8)
        seen = np.isfinite(t)
        t, strength = np.where(seen, t, 1), np.where(seen, albedo * facing, 0)
        if "wall_m" in case:
            forward = direction[..., 0] * cos_b + direction[..., 1] * sin_b
            wall = case["wall_m"] / forward
            t, strength = np.where(seen, t, wall), np.where(seen, strength, 0.5 * forward)
        if "floor_m" in case:
            down = -direction[..., 2]
            floor = case["floor_m"] / np.where(down > 0, down, 1e-9)
            nearer = ~seen & (down > 0) & ((strength == 0) | (floor < t))
            t, strength = np.where(nearer, floor, t), np.where(nearer, 0.5 * down, strength)
        distance = t * length
        light = strength / length / distance**2
        phase = distance / SENSOR.metres_per_radian
        pixels = (density, 16, density)
        real = (light * np.cos(phase)).reshape(pixels).mean(axis=(0, 2), dtype=np.float64)
        imaginary = (light * np.sin(phase)).reshape(pixels).mean(axis=(0, 2), dtype=np.float64)
        result[row] = real + 1j * imaginary
    return result


SECTIONS: dict[str, tuple[str, Callable[[], Table]]] = {
    "accuracy": ("Error against frames integrated from the true solids", accuracy),
    "rendering": ("Rendering", rendering),
    "lenses": ("Lenses with distortion", lenses),
    "peer": ("Against supersampling", peer),
    "banks": ("Banks", banks),
    "million": ("A frame set of a million frames", million),
    "capture": ("Capturing noisy frames", capturing),
    "chain": ("Capture, filters, matching", chain),
    "sweep": ("A sweep with its report", sweep),
    "mounting": ("Calibrating a mounting on 50 poses", mounting),
    "design": ("Designing a set of landmarks", design),
    "matching": ("Errors over the Cramér–Rao bound", partial(matching, SENSOR, SEED)),
    "tolerance": ("In a world that is not the model's", partial(tolerance, SENSOR, SEED)),
    "direct": ("A direct sensor of 8 × 8 zones and 128 bins", partial(direct, SEED, median_seconds)),
    "regions": ("A large camera, binned", partial(regions, SENSOR, SEED)),
    "scenes": ("Scenes of 50 bodies", partial(scenes, SEED, median_seconds)),
    "policy": ("What the tuning numbers of the search do", partial(policy, SENSOR, SEED)),
}


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows as a Markdown table."""
    if not rows:
        return ""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    for row in rows:
        cells = [f"{value:g}" if isinstance(value, float) else str(value) for value in row.values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the sections asked for, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; default: all but policy"
    )
    names = parser.parse_args().sections or [name for name in SECTIONS if name != "policy"]  # which takes an hour
    for name in names:
        if name not in SECTIONS:
            parser.error(f"unknown section '{name}': the sections are {', '.join(SECTIONS)}")
    results: dict[str, Any] = {
        "machine": f"{platform.processor() or platform.machine()}, {len(os.sched_getaffinity(0))} processors",
        "python": platform.python_version(),
    }
    print(f"Machine: {results['machine']}, Python {results['python']}\n")
    for name in names:
        title, measure = SECTIONS[name]
        print(f"## {title}\n", flush=True)
        results[name] = measure()
        print(markdown(results[name]["rows"]))
        for key, value in results[name].items():
            if key != "rows":
                print(f"\n{key}: {value}")
        print(flush=True)
    results["peak memory (MiB)"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    out = ROOT / "out"
    out.mkdir(exist_ok=True)
    (out / "bench.json").write_text(json.dumps(results, indent=2, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    main()
