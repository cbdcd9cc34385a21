"""The fields of a sensor: their types, limits and defaults, and which belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    model_serializer,
    model_validator,
)

from phasemark import UsageError
from phasemark.inputs.field_table import FieldTable
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.lens_fields import Lens, with_geometry_of_lens

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_LARGEST = 1e12
"""Of any number of a sensor: the square of none overflows, and the reciprocal of none is infinite."""


def _not_vanishing(value: float) -> float:
    if value < 1 / _LARGEST:
        raise ValueError(f"must be at least {1 / _LARGEST:g}")
    return value


_Positive = Annotated[float, Field(gt=0, le=_LARGEST, allow_inf_nan=False), AfterValidator(_not_vanishing)]
_NonNegative = Annotated[float, Field(ge=0, le=_LARGEST, allow_inf_nan=False)]
_Fraction = Annotated[float, Field(gt=0, le=1)]
_HalfAngleDeg = Annotated[float, Field(gt=0, lt=85)]
_TiltDeg = Annotated[float, Field(ge=-45, le=45)]
_TurnDeg = Annotated[float, Field(ge=-180, le=180)]
_MountHeight = Annotated[float, Field(ge=-10, le=10)]
_PixelCount = Annotated[int, Field(ge=1, le=4096)]
_ImageSide = Annotated[float, Field(gt=0, le=4096)]
_Share = Annotated[float, Field(ge=0, lt=1)]
_Finite = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST, allow_inf_nan=False)]
_Order = Annotated[int, Field(ge=2, le=199)]
_Pixel = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]
_Row = tuple[_Finite, ...]
_LampHalfAngleDeg = Annotated[float, Field(gt=0, le=180)]
_CosinePower = Annotated[float, Field(ge=0, le=1000)]
_LampSample = tuple[Annotated[float, Field(ge=0, le=180)], _NonNegative]
_PulseShape = tuple[_NonNegative, ...]

_ONE, _SEVERAL = "one frequency", "several frequencies"
_MOST_FREQUENCIES = 16


def _without_list_of_one(value: Any) -> Any:
    """Return the one number of a list of one, which means the same."""
    return value[0] if isinstance(value, list | tuple) and len(value) == 1 else value


_Frequencies = Annotated[
    Annotated[_Positive, Tag(_ONE)]
    | Annotated[tuple[_Positive, ...], Field(min_length=1, max_length=_MOST_FREQUENCIES), Tag(_SEVERAL)],
    Discriminator(lambda value: _SEVERAL if isinstance(value, list | tuple) else _ONE),
    BeforeValidator(_without_list_of_one),
]

_POWER, _SAMPLES = "a power of the cosine", "samples"
_LampProfile = Annotated[
    Annotated[_CosinePower, Tag(_POWER)] | Annotated[tuple[_LampSample, ...], Field(min_length=2), Tag(_SAMPLES)],
    Discriminator(lambda value: _SAMPLES if isinstance(value, list | tuple) else _POWER),
]

TABLES: dict[str, type[FieldTable]] = {"lens": Lens, "histogram": Histogram}
"""Fields that are tables of their own in a sensor file, and left out where there is none."""


class SensorFields(FieldTable):
    """Define the fields of a camera; :class:`~phasemark.render.Sensor` documents each."""

    kind: Literal["phase", "direct"] = "phase"
    # geometry
    rows: _PixelCount
    cols: _PixelCount
    lens: Lens | None = None
    half_angle_h_deg: _HalfAngleDeg
    half_angle_v_deg: _HalfAngleDeg
    principal_point_px: tuple[float, float] | None = None
    whole_image_px: tuple[_ImageSide, _ImageSide] | None = None
    pitch_deg: _TiltDeg = 0.0
    roll_deg: _TiltDeg = 0.0
    bearing_offset_deg: _TurnDeg = 0.0
    height_offset_m: _MountHeight = 0.0
    fill_factor: tuple[_Fraction, _Fraction] = (1.0, 1.0)
    vignetting: bool = False
    lamp_half_angle_deg: _LampHalfAngleDeg | None = None
    lamp_profile: _LampProfile = 0.0
    # modulation and timing
    modulation_hz: _Frequencies = 10e6
    frame_rate_hz: _Positive = 3.0
    phase_interval_s: _Positive | None = None
    delay_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    contrast: _Fraction = 0.5
    modulation: Literal["sine", "square", "harmonics", "pulse"] = "sine"
    max_harmonic: _Order = 49
    harmonics: tuple[tuple[_Order, _Fraction, _Finite], ...] = ()
    emitted_pulse: _PulseShape = ()
    reference_pulse: _PulseShape = ()
    # electrons
    signal_e: _Positive = 35_571.0
    ambient_e: _NonNegative = 0.0
    dark_e: _NonNegative = 0.0
    shot_noise: bool = True
    read_noise_e: _NonNegative = 0.0
    prnu: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    dsnu_e: _NonNegative = 0.0
    # read-out
    full_well_e: _Positive | None = None
    adc_bits: Annotated[int, Field(ge=1, le=32)] | None = None
    gain: _Positive = 1.0
    black_level: _NonNegative = 0.0
    # offsets
    phase_offset_std_rad: Annotated[float, Field(ge=0, le=1)] = 0.0
    tap_phase_offset_std_rad: Annotated[float, Field(ge=0, le=1)] = 0.0
    range_offset_m: _Finite = 0.0
    unit_seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    # stray light
    blur_share: _Share = 0.0
    blur_px: _Positive = 1.0
    veil_share: _Share = 0.0
    veil_px: _Positive = 8.0
    # defects
    dead_share: _Share = 0.0
    hot_share: _Share = 0.0
    dead_pixels: tuple[_Pixel, ...] = ()
    hot_pixels: tuple[_Pixel, ...] = ()
    hot_e: _NonNegative = 10_000.0
    # validity
    max_phase_std_rad: _Positive | None = None
    min_amplitude_e: _NonNegative = 0.0
    wrap_guard_m: _NonNegative = 0.0
    # direct time of flight
    max_range_m: _Positive | None = None
    min_intensity: _NonNegative = 0.0
    range_std_m: _NonNegative = 0.0
    range_shot_std_m: _NonNegative = 0.0
    range_ambient_std_m: _NonNegative = 0.0
    zone_offset_m: tuple[_Row, ...] = ()
    histogram: Histogram | None = None
    # what a calibration leaves
    calibration_fields: tuple[str, ...] = ()
    calibration_covariance: tuple[_Row, ...] = ()
    systematic_distance_m: _NonNegative = 0.0
    systematic_delta_deg: _NonNegative = 0.0
    systematic_bearing_deg: _NonNegative = 0.0
    systematic_height_m: _NonNegative = 0.0
    systematic_time_s: _NonNegative = 0.0
    overdispersion: _NonNegative = 0.0
    recording_range_m: _NonNegative = 0.0
    recording_pitch_deg: _NonNegative = 0.0
    recording_roll_deg: _NonNegative = 0.0
    recording_bearing_deg: _NonNegative = 0.0

    @model_validator(mode="before")
    @classmethod
    def _complete_geometry(cls, data: dict[str, Any]) -> dict[str, Any]:
        return with_geometry_of_lens(data)

    @classmethod
    def _refusal(cls, first: ErrorDetails) -> UsageError:
        location = tuple(part for part in first["loc"] if part not in (_ONE, _SEVERAL, _POWER, _SAMPLES))
        return super()._refusal({**first, "loc": location})

    @model_serializer(mode="wrap")
    def _without_absent_tables(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `histogram` and `lens` where there is none, so that files read as before sensors had these tables."""
        fields: dict[str, Any] = dump(self)
        for name in TABLES:
            if fields.get(name, ...) is None:
                del fields[name]
        return fields


def _in_groups() -> dict[str, tuple[str, ...]]:
    titles = {
        "kind": "kind",
        "rows": "geometry",
        "modulation_hz": "modulation and timing",
        "signal_e": "electrons per phase image",
        "full_well_e": "read-out",
        "phase_offset_std_rad": "offsets of one physical camera",
        "blur_share": "stray light",
        "dead_share": "defects",
        "max_phase_std_rad": "validity",
        "max_range_m": "direct time of flight only",
        "calibration_fields": "what a calibration leaves",
    }
    groups: dict[str, tuple[str, ...]] = {}
    title = ""
    for name in SensorFields.model_fields:
        title = titles.get(name, title)
        groups[title] = (*groups.get(title, ()), name)
    return groups


FIELD_GROUPS = _in_groups()
"""The fields in groups, in the order of light's way through the camera: title → names."""

OPTICS = tuple(
    "centre_px" if name == "principal_point_px" else name
    for name in (*FIELD_GROUPS["geometry"], "modulation_hz")
    if name != "whole_image_px"
)
"""What an image's rays and phases depend on: cameras that agree in these see the same noise-free image."""

DIRECT_ONLY = FIELD_GROUPS["direct time of flight only"]
CALIBRATION = FIELD_GROUPS["what a calibration leaves"]
"""Fields that move no image and add no noise to a frame."""

_NOT_PHASE_ONLY = {
    *FIELD_GROUPS["kind"], *FIELD_GROUPS["geometry"], *DIRECT_ONLY, *CALIBRATION, "modulation_hz", "frame_rate_hz",
    "delay_s", "range_offset_m", "unit_seed", "dead_share", "dead_pixels",
}  # fmt: skip
PHASE_ONLY = tuple(name for name in SensorFields.model_fields if name not in _NOT_PHASE_ONLY)
"""Fields that only a camera with taps has."""
