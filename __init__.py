"""phasemark: what a low-resolution time-of-flight camera sees of a 3D landmark, and what a robot learns from it.

The work is done in four rooms: :mod:`phasemark.landmarks` (what stands in the world), :mod:`phasemark.render`
(how the camera sees it), :mod:`phasemark.data` (what is kept) and :mod:`phasemark.matcher` (what the robot
concludes). This module holds the version and the error taxonomy, one class per exit code of the command line. It
imports the names that a first script needs from the rooms when they are used.
"""

__version__ = "0.1.0"

TYPE_CHECKING = False  # type checkers take it for true; importing it from typing would cost more than all below
if TYPE_CHECKING:
    from phasemark.data import build_bank, read_frames
    from phasemark.landmarks import read_mesh
    from phasemark.landmarks.catalog import catalog
    from phasemark.matcher import Matcher, kalman_filter, robot_poses
    from phasemark.render import Renderer, capture, preset
else:

    def __getattr__(name):
        return _on_use()[0](name)

    def __dir__():
        return _on_use()[1]()

    def _on_use():
        from phasemark.inputs.on_use import imported_on_use  # not before: it takes longer than this module

        return imported_on_use(__name__)


__all__ = [
    "InputFileError",
    "Matcher",
    "OutputExistsError",
    "PhasemarkError",
    "Renderer",
    "StorageError",
    "UsageError",
    "__version__",
    "build_bank",
    "capture",
    "catalog",
    "kalman_filter",
    "preset",
    "read_frames",
    "read_mesh",
    "robot_poses",
]


_TYPES = {
    "string_type": "a string",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}
"""What is right where pydantic finds another type."""

_PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9_.-]*$": "begin with a letter or digit and hold only letters, digits, '_', '.' and '-'",
    r"^[A-Za-z0-9][A-Za-z0-9_. -]*$": "begin with a letter or digit, then letters, digits, spaces, '_', '.' and '-'",
    r"^[^:\s]+:[^:\s]+$": "be MODULE:NAME of a function of your own",
    r"^(nearest|refine|[A-Za-z_][\w.]*:[A-Za-z_]\w*)$": "be nearest, refine, or MODULE:NAME of a callable of your own",
}
"""What the patterns of fields say, in words."""


def _in_words(kind: str, message: str) -> str:
    """Return what would be right, ``must …``, of a finding of pydantic."""
    if kind in _TYPES:
        return f"must be {_TYPES[kind]}"
    if kind == "string_pattern_mismatch":
        pattern = message.partition("'")[2].removesuffix("'")
        return f"must {_PATTERNS.get(pattern, f'match {pattern}')}"
    subject, should, rest = message.partition(" should ")
    if should and " " not in subject:  # "Tuple should have at least 1 item after validation, not 0"
        message = f"must {rest.partition(' after validation')[0]}"
    return message if message.startswith("must") else f"must be {message}"


def _quoted(text: str) -> str:
    """Return what stands between the first quotation marks."""
    return text.split("'")[1]


class PhasemarkError(Exception):
    """Base of every error the user can mend; its message is one line that says what to do.

    ``exit_code`` is the exit code of the command line for it.
    """

    exit_code = 1


class UsageError(PhasemarkError, ValueError):
    """A wrong argument, option or plan (exit code 2)."""

    exit_code = 2

    @classmethod
    def of_field(cls, location: tuple[int | str, ...], kind: str, message: str, value: object) -> "UsageError":
        """Put one finding of a pydantic ``ValidationError`` into one line: key, what would be right, value.

        Parameters
        ----------
        location, kind, message, value
            ``loc``, ``type``, ``msg`` and ``input`` of the first entry of the error's ``errors()``.
        """
        of_key = location[-1:] == ("[key]",)  # the finding is about a key of a table, not about its value
        key = ".".join(str(part) for part in (location[:-2] if of_key else location))
        if kind == "extra_forbidden":
            return cls(f"unknown key '{key}'")
        if kind == "missing":
            return cls(f"'{key}' is missing")
        if kind == "union_tag_not_found":
            return cls(f"'{key}.{_quoted(message)}' is missing")
        own = message.removeprefix("Value error, ")
        if own != message and own.startswith("'"):  # a nested model has put its own finding into words already
            return cls(f"{key}: {own}")
        named = f"each key of '{key}'" if of_key else f"'{key}'"
        if kind == "union_tag_invalid":
            tag = message.partition(" using ")[2]
            named = f"'{key}.{_quoted(tag)}'"
            value = _quoted(message)
            own = f"must be one of {message.partition('expected tags: ')[2]}"
        shown = repr(value)
        return cls(f"{named} {_in_words(kind, own)}, got {shown if len(shown) <= 80 else shown[:77] + '...'}")


class InputFileError(PhasemarkError, ValueError):
    """An input file that is missing, damaged or not what it should be (exit code 3)."""

    exit_code = 3


class OutputExistsError(PhasemarkError):
    """An output that exists already, is locked, or does not fit what is being resumed (exit code 4)."""

    exit_code = 4


class StorageError(PhasemarkError):
    """The disk is full or fails (exit code 5)."""

    exit_code = 5
