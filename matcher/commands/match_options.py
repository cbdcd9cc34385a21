"""Options of ``phasemark match``: method, place of the landmark, and output."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from phasemark import UsageError
from phasemark.data.commands.command import Shown, stated_flags
from phasemark.data.commands.console import LongWork, tell
from phasemark.data.commands.inputs import (
    background_to_estimate,
    open_any_bank,
    read_landmark,
    read_sensor,
    sensor_of_board,
)
from phasemark.data.commands.options import (
    BouncesOfLight,
    Degrees,
    Floor,
    Force,
    FrameReading,
    Json,
    MeshReading,
    MeshUnitWord,
    Metres,
    Origin,
    SensorName,
    Up,
    Wall,
    one_of,
)
from phasemark.data.commands.outputs import refuse_other_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from phasemark.data import Bank
    from phasemark.matcher import FilteredFrames, Match, Matcher
    from phasemark.matcher.position.landmark_map import LandmarkMap
    from phasemark.render import Background, Frames


_REFINED = (
    "free", "on", "pixels", "robust", "auto_background", "unknown_background", "no_background", "fix", "bearing_std",
    "same_recording",
)  # fmt: skip
"""Options of :class:`Search` that the nearest image does not have."""

_FREE = {"bearing": "bearing_rad", "height": "height_m", "pitch": "pitch_rad", "roll": "roll_rad"}


@dataclass(frozen=True)
class Search:
    """Options for averaging and matching frames.

    Parameters
    ----------
    filter_name
        How frames are averaged.
    method
        refine: maximum likelihood, with covariance. nearest: the paper's minimum-distance classifier. Unless stated:
        refine, or nearest where the bank knows no mixed pixels.
    free
        With refine: estimate bearing, height, pitch or roll too; repeatable. Bearing and height are taken as unknown,
        pitch and roll as near 0.
    pitch_std
        With --free pitch: standard deviation of the pitch; 3 unless stated.
    roll_std
        With --free roll: standard deviation of the roll; 3 unless stated.
    height_std
        With --free height: standard deviation of the height; unknown unless stated.
    fix
        With refine: keep at 0, not estimated; only: bearing.
    bearing_std
        With refine: standard deviation of the bearing; 1.5, with --on reported 3, unless --free or --fix is given.
    on
        With refine: ranges, or phasors with the albedo free; of a direct sensor also reported (ranges as its chip makes
        them), histograms or targets. Unless stated: ranges, or reported where the sensor has a [histogram] table,
        except with --unknown-background and --no-background.
    pixels
        With refine: pixels that are compared, all or the lower half of the rows.
    robust
        With refine: give residuals beyond 3 σ less weight.
    false_alarm
        Share of good frames that the test of the fit may refuse.
    auto_background
        With refine: estimate wall and floor from each frame; from histograms a wall.
    unknown_background
        With refine: other things may stand before, beside and behind it.
    no_background
        With refine: nothing returns beside it. Unless the background is stated, nothing, wall and floor, and unknown
        things are tried in turn, until one explains the frame.
    floor_albedo
        With --floor and --bounces: albedo of the floor; estimated between 0.05 and 0.6 unless stated.
    same_recording
        With refine: leave out the differences between recordings, for frames that calibrated the sensor.
    """

    filter_name: Literal["kalman", "phasor-mean"] = "kalman"
    method: Literal["nearest", "refine"] | None = None
    free: Annotated[list[str] | None, Shown(autocompletion=one_of(*_FREE))] = None
    pitch_std: Degrees | None = None
    roll_std: Degrees | None = None
    height_std: Metres | None = None
    fix: Annotated[Literal["bearing"] | None, Shown(metavar="NAME")] = None
    bearing_std: Degrees | None = None
    on: Literal["ranges", "reported", "phasors", "histograms", "targets"] | None = None
    pixels: Literal["all", "lower"] = "all"
    robust: bool = False
    false_alarm: float = 0.01
    auto_background: bool = False
    unknown_background: bool = False
    no_background: bool = False
    same_recording: bool = False
    wall: Wall = None
    floor: Floor = None
    bounces: BouncesOfLight = "0"
    floor_albedo: float | None = None

    @property
    def background(self) -> Background | None:
        """What stands behind the landmark, as far as it is stated."""
        return background_to_estimate(self.wall, self.floor, self.bounces, self.floor_albedo)

    @property
    def behind(self) -> Background | Literal["auto", "unknown", "any"] | None:
        """Background of the matcher: what is stated, or what the frames tell."""
        if self.unknown_background or self.on == "reported":
            return "unknown"
        if self.auto_background:
            return "auto"
        stated = self.no_background or self.background is not None
        return self.background if stated or self.method == "nearest" or self.is_direct else "any"

    @property
    def is_direct(self) -> bool:
        """Whether histograms or targets of a direct sensor are matched."""
        return self.on in ("histograms", "targets")

    @property
    def near_the_axis(self) -> bool:
        """Whether the bearing is estimated with what is known of it, as nothing else is asked for."""
        return self.method != "nearest" and not self.free and not self.fix

    @property
    def _stated_std(self) -> dict[str, float | None]:
        """How well what is free is known before, where that is stated: metres and degrees."""
        return {"height": self.height_std, "pitch": self.pitch_std, "roll": self.roll_std}

    @property
    def parameters(self) -> list[str]:
        """What is estimated."""
        free = ["bearing"] if self.near_the_axis else self.free or ()
        return ["distance_m", "delta_rad", *(_FREE[name] for name in sorted(free, key=list(_FREE).index))]

    def filter(self) -> Callable[[Frames], FilteredFrames]:
        """Return the filter that averages the frames of a position."""
        from phasemark.matcher import kalman_filter, phasor_mean

        return kalman_filter if self.filter_name == "kalman" else phasor_mean

    def check(self) -> None:
        """Refuse options that contradict each other."""
        stated = self.background is not None
        if self.auto_background and stated:
            raise UsageError("--auto-background estimates wall and floor: leave --wall and --floor out")
        if self.unknown_background and (self.auto_background or stated):
            raise UsageError(
                "--unknown-background takes nothing for known: leave --auto-background, --wall and --floor out"
            )
        if self.no_background and (self.auto_background or self.unknown_background or stated):
            raise UsageError(
                "--no-background states that nothing returns beside the landmark: leave --auto-background,"
                " --unknown-background, --wall and --floor out"
            )
        if self.bearing_std is not None and (self.free or self.fix):
            raise UsageError("--bearing-std says how well the bearing is known: leave --free and --fix out")
        if self.fix and "bearing" in (self.free or ()):
            raise UsageError("--free and --fix both name bearing: give one of them")
        for name in self.free or ():
            if name not in _FREE:
                raise UsageError(f"--free must be bearing, height, pitch or roll, got '{name}'")
        for name, std in self._stated_std.items():
            if std is not None and name not in (self.free or ()):
                raise UsageError(f"--{name}-std goes with --free {name}: what is not free is 0")
        if self.is_direct:
            self._check_direct()
        if self.method == "nearest":
            for option in stated_flags(self, *_REFINED):
                if option != "--on" or self.on != "ranges":
                    raise UsageError(f"{option} goes with --method refine: the nearest image has nothing of the kind")

    def _check_direct(self) -> None:
        """Refuse options that belong to images of ranges."""
        for option in stated_flags(self, "pixels", "robust", "unknown_background", "same_recording", "filter_name"):
            raise UsageError(f"{option} goes with images of ranges: leave it out with --on {self.on}")
        if self.auto_background and self.on == "targets":
            raise UsageError("--auto-background takes histograms: with --on targets give --wall and --floor")

    def matcher(self, bank: Bank) -> Matcher:
        """Return the matcher."""
        from phasemark.matcher import Matcher
        from phasemark.matcher.likelihood.systematic import SYSTEMATICS

        known: dict[str, Any] = {
            _FREE[name].replace("_", "_std_"): math.radians(std) if _FREE[name].endswith("_rad") else std
            for name, std in {"bearing": self.bearing_std, **self._stated_std}.items()
            if std is not None
        }
        return Matcher(
            bank,
            self.method or "refine",
            free=None if self.near_the_axis else self.parameters,
            background=self.behind,
            false_alarm=self.false_alarm,
            on=self.on or "ranges",
            pixels=self.pixels,
            robust=self.robust,
            systematic=[term for term in SYSTEMATICS if term != "recording"] if self.same_recording else None,
            **known,
        )

    def for_bank(self, bank: Bank) -> Search:
        """Return the options with what is not stated: the method, and ranges as a chip reports them where one did."""
        if self.is_direct:
            return self
        method = self.method or ("refine" if bank.plan.model == "ray" else "nearest")
        from_mean = method == "nearest" or self.unknown_background or self.no_background
        chip = bank.sensor.histogram is not None and not from_mean
        found = replace(self, method=method, on=self.on or ("reported" if chip else "ranges"))
        if found.on == "reported" and (self.auto_background or self.no_background or self.background is not None):
            tell(
                "note: of ranges as a chip reports them what stands behind the landmark is unknown; --on ranges takes"
                " --auto-background, --no-background, --wall and --floor"
            )
        return found


@dataclass(frozen=True)
class Landmark:
    """Options for a mesh or a class in place of a bank.

    Parameters
    ----------
    sensor
        Without a bank: a preset or sensor file; unless stated, that of the board that printed the frames.
    part_unit
        Unit of a mesh: m, cm, mm or inch; that of --unit unless stated.
    no_cache
        Without a bank: build one again, and do not keep it.
    """

    sensor: SensorName | None = None
    part_unit: Annotated[MeshUnitWord | None, Shown(metavar="UNIT")] = None
    up: Up = "z"
    origin: Origin = "file"
    no_cache: bool = False

    def check(self, bank: Path) -> None:
        """Refuse options that belong to a mesh or a class beside a bank."""
        if not self.is_for(bank):
            for option in stated_flags(self):
                raise UsageError(f"{option} goes with a mesh or a class in place of a bank: {bank} has its own")

    @staticmethod
    def is_for(bank: Path) -> bool:
        """Return whether an argument is a mesh or a class, not a bank."""
        from phasemark.landmarks import catalog
        from phasemark.landmarks.mesh_files import FORMATS

        return str(bank) in catalog() or bank.suffix.lower().removeprefix(".") in FORMATS

    def opened(self, name: Path, frames: Path, reading: FrameReading) -> Bank:
        """Return a bank, or that of a mesh or a class over the distances that frames ask for: a kept or a new one."""
        if not self.is_for(name):
            return open_any_bank(name)
        from phasemark.landmarks import catalog
        from phasemark.matcher.recordings.bank_for_frames import distances_of_frames

        camera_name = self.sensor or sensor_of_board(frames, reading.board)
        camera = read_sensor(camera_name)
        unit = self.part_unit or reading.unit
        if str(name) in catalog() and (self.part_unit or self.up != "z" or self.origin != "file"):
            raise UsageError(f"--part-unit, --up and --origin belong to a mesh: '{name}' is a class of the catalogue")
        _, mesh = read_landmark(str(name), MeshReading(unit, self.up, self.origin))
        return self.built(name, camera_name, unit, distances_of_frames(reading.read(frames, camera), mesh))

    def built(self, name: Path, camera_name: str, unit: MeshUnitWord | None, distance_m: Any) -> Bank:
        """Return the bank of a mesh or a class over some distances: a kept or a new one."""
        from phasemark.data import BankPlan
        from phasemark.data.bank.build_bank import cached_bank
        from phasemark.data.plans.bank_plan import MeshPlan
        from phasemark.landmarks import catalog

        shown: dict[str, Any] = {"classes": (str(name),), "layout": "factored"}
        if str(name) not in catalog():
            mesh = MeshPlan(name=name.stem, path=str(name), unit=unit, up=self.up, origin=self.origin)
            shown = {"meshes": (mesh,), "layout": "full"}
        plan = BankPlan(sensor=camera_name, distance_m=distance_m, **shown).resolve()
        with LongWork("building a bank") as progress:
            return cached_bank(plan, keep=not self.no_cache, progress=progress)


@dataclass(frozen=True)
class Place:
    """Poses of the landmarks, and the expected pose of the robot.

    Parameters
    ----------
    landmark_xy
        Place of the landmark, metres.
    landmark_yaw
        Heading of its x' axis.
    pan
        Pan angle of the camera on the robot.
    prior
        Expected pose of the robot; the nearest solution comes first.
    prior_std
        Standard deviations of the expected pose: of x and y, and of the heading.
    map_file
        Map of the landmarks (.toml), instead of --landmark-xy.
    """

    landmark_xy: Annotated[tuple[float, float] | None, Shown(metavar="X Y")] = None
    landmark_yaw: Degrees = 0.0
    pan: Degrees = 0.0
    prior: Annotated[tuple[float, float, float] | None, Shown(metavar="X Y DEG")] = None
    prior_std: Annotated[tuple[float, float] | None, Shown(metavar="M DEG")] = None
    map_file: Annotated[Path | None, Shown(metavar="MAP")] = None

    def check(self) -> None:
        """Refuse options that contradict each other, or lack what they belong to."""
        if self.map_file is not None and self.landmark_xy is not None:
            raise UsageError("--map and --landmark-xy both say where the landmark stands: give one of them")
        if self.prior is not None and not self.is_stated:
            raise UsageError("--prior needs --landmark-xy or --map: without it there is no robot position")
        if self.prior_std is not None and self.prior is None:
            raise UsageError("--prior-std needs --prior, which it belongs to")
        if self.prior_std is not None and not min(self.prior_std) > 0:
            x, heading = self.prior_std
            raise UsageError(f"--prior-std must be two positive numbers, got {x:g} {heading:g}")
        x, y = self.landmark_xy or (0.0, 0.0)
        if not all(map(math.isfinite, (x, y, self.landmark_yaw, self.pan))):
            raise UsageError(
                f"--landmark-xy, --landmark-yaw and --pan must be finite numbers, got {x:g} {y:g},"
                f" {self.landmark_yaw:g} and {self.pan:g}"
            )

    @property
    def is_stated(self) -> bool:
        """Whether it is said where landmarks stand."""
        return self.map_file is not None or self.landmark_xy is not None

    def landmarks(self) -> LandmarkMap | None:
        """Return the map of the landmarks, if one is given."""
        from phasemark.matcher.position.landmark_map import read_landmark_map

        return None if self.map_file is None else read_landmark_map(self.map_file)

    def poses(self, match: Match, landmarks: LandmarkMap | None) -> list[dict[str, Any]]:
        """Return the robot poses of a match as plain numbers, best first; none if there is no landmark."""
        from phasemark.matcher import robot_poses

        believed: dict[str, Any] = {}
        if self.prior is not None:
            believed["prior"] = (*self.prior[:2], math.radians(self.prior[2]))
        if self.prior_std is not None:
            xy, heading = self.prior_std[0] ** 2, math.radians(self.prior_std[1]) ** 2
            believed["prior_covariance"] = [[xy, 0.0, 0.0], [0.0, xy, 0.0], [0.0, 0.0, heading]]
        pan_rad = math.radians(self.pan)
        if landmarks is not None:
            placed = landmarks.poses(match, pan_rad, **believed)
            return [{"landmark": one.landmark.name, **one.pose.as_dict()} for one in placed]
        xy_m, yaw_rad = self.landmark_xy or (0.0, 0.0), math.radians(self.landmark_yaw)
        return [pose.as_dict() for pose in robot_poses(match, xy_m, yaw_rad, pan_rad, **believed)]


@dataclass(frozen=True)
class Results:
    """Options for printed and written output.

    Parameters
    ----------
    estimates
        Write a line for each position into this .csv.
    plot
        Draw measured, model and residual into this .png; of several positions, number K into -K.
    plot_index
        Positions to draw, such as 0,17,200:210. By default all, or the first of more than 4.
    no_diagnosis
        Do not look for the setting that makes a refused frame fit.
    as_jsonl
        Print each match as a line of JSON as soon as it is known.
    """

    estimates: Annotated[Path | None, Shown(metavar="FILE")] = None
    plot: Path | None = None
    plot_index: Annotated[str | None, Shown(metavar="LIST")] = None
    no_diagnosis: bool = False
    as_json: Json = False
    as_jsonl: Annotated[bool, Shown("--jsonl")] = False
    force: Force = False

    def check(self) -> None:
        """Refuse names of a wrong kind, and options that contradict each other."""
        if self.plot is not None:
            refuse_other_files(self.plot, ".png")
        if self.plot is None and self.plot_index is not None:
            raise UsageError("--plot-index needs --plot, the file to draw into")
        if self.estimates is not None:
            refuse_other_files(self.estimates, ".csv", "the estimates")
        if self.as_json and self.as_jsonl:
            raise UsageError("--json and --jsonl are two forms of the same output: give one of them")

    def plots(self, n: int) -> dict[int, Path]:
        """Return which of n positions to draw, and into which files; of several, with a number before the suffix."""
        from phasemark.data.plans.grid_axis import parse_indices

        if self.plot is None:
            return {}
        if self.plot_index is not None:
            indices = parse_indices(self.plot_index, n, "--plot-index")
        else:
            # most positions that are drawn unless the user says which, also in the help; a figure takes two seconds
            drawn_all = 4
            indices = list(range(n if n <= drawn_all else 1))
        return {k: self.plot if n == 1 else self.plot.with_stem(f"{self.plot.stem}-{k}") for k in indices}

    def files(self, plots: dict[int, Path]) -> list[Path]:
        """Return all files that are written."""
        return [*([] if self.estimates is None else [self.estimates]), *plots.values()]


def check_delay(delay_ms: float) -> None:
    """Refuse a delay that no stamp of a frame has."""
    most_ms = 10_000
    if not abs(delay_ms) <= most_ms:
        raise UsageError(f"--delay-ms must be from -{most_ms} to {most_ms}, got {delay_ms:g}")
