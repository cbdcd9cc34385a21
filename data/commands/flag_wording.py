"""Messages of the library in the words of the command line: parameters become flags."""

from __future__ import annotations

import re

_NAMED_ALIKE = (
    "amplitude_unit", "board", "content", "flip_h", "flip_v", "force", "free", "generator", "moving", "quantity",
    "resume", "rotate", "scheduler", "to", "topic", "unit", "valid_status",
)  # fmt: skip
FLAGS = {
    **{name: f"--{name.replace('_', '-')}" for name in _NAMED_ALIKE},
    "background": "--wall, --floor",
    "fixed": "--fix",
    "n": "--population",
    "part": "--shard",
    "pose_std": "--position-std, --heading-std and --delta-std",
    "trusted": "--matcher",
}
"""Parameters that messages name, as ``name=value``, ``name=True`` or ``name=…``, and their flags."""
PHRASES = {
    "Mounting(delay_s=…)": "--delay-ms",
    "landmark_yaw_rad=…": "--landmark-yaw",
    "bounces and a positive floor_albedo_std of the background": "--bounces, without --floor-albedo",
    "layout='full'": "--full, layout = 'full'",
    "pose_times_s(delay_s=…)": "match --delay-ms",
    "leave refuse_programs() out": "give --trust-plan",
    "leave refuse_generator() out": "give --trust-plan",
    "run_sweep(resume=True)": "'phasemark sweep run --resume'",
    "unverified()": "--no-verify",
}
"""What messages name that is no parameter of the call, and what the command line has for it."""
_WITH_VALUES = (
    "amplitude_unit", "board", "content", "fixed", "free", "generator", "quantity", "scheduler", "trusted", "unit",
)  # fmt: skip
"""Parameters that messages name with a value; others may stand in what a user wrote (``--mesh n=part.stl``)."""
_STATED = rf"(?:({'|'.join(FLAGS)})=(?:…|True\b))"
_VALUED = rf"(?:({'|'.join(_WITH_VALUES)})=(?=\w)|(part)=(?=\d+/))"
_PARAMETER = re.compile(rf"(?<![\w'/.-])(?<!--mesh )(?:{_STATED}|{_VALUED})")


def in_flags(message: str) -> str:
    """Return a message that names flags where the library names parameters; names in quotes stay.

    Examples
    --------
    >>> in_flags("b.h5: exists; use force=True to replace it")
    'b.h5: exists; use --force to replace it'
    >>> in_flags("say with topic=… which images to read, or give unit=mm")
    'say with --topic which images to read, or give --unit mm'
    """
    for phrase, words in PHRASES.items():
        message = message.replace(phrase, words)
    return _PARAMETER.sub(_flag, message)


def _flag(match: re.Match[str]) -> str:
    return FLAGS[match[1]] if match[1] else f"{FLAGS[match[2] or match[3]]} "
