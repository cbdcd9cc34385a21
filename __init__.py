"""phasemark: what a low-resolution time-of-flight camera sees of a 3D landmark, and what a robot learns from it.

The work is done in four rooms: :mod:`phasemark.landmarks` (what stands in the world), :mod:`phasemark.render`
(how the camera sees it), :mod:`phasemark.data` (what is kept) and :mod:`phasemark.matcher` (what the robot
concludes). This module holds the version and the error taxonomy, one class per exit code of the command line.
"""

__version__ = "0.1.0"

__all__ = ["InputFileError", "OutputExistsError", "PhasemarkError", "StorageError", "UsageError", "__version__"]


class PhasemarkError(Exception):
    """Base of every error the user can mend; its message is one line that says what to do.

    ``exit_code`` is what the command line returns for it.
    """

    exit_code = 1


class UsageError(PhasemarkError, ValueError):
    """A wrong argument, option or plan (exit code 2)."""

    exit_code = 2

    @classmethod
    def of_field(
        cls, location: tuple[int | str, ...], kind: str, message: str, value: object, whole: str = ""
    ) -> "UsageError":
        """Put one finding of a pydantic ``ValidationError`` into one line: key, what would be right, value.

        Parameters
        ----------
        location, kind, message, value
            ``loc``, ``type``, ``msg`` and ``input`` of the first entry of the error's ``errors()``.
        whole : str
            The key to name when the finding is about the model as a whole.
        """
        key = ".".join(str(part) for part in location) or whole
        if kind == "extra_forbidden":
            return cls(f"unknown key '{key}'")
        if kind == "missing":
            return cls(f"'{key}' is missing")
        own = message.removeprefix("Value error, ")
        if own != message and own.startswith("'"):  # a nested model has put its own finding into words already
            return cls(f"{key}: {own}")
        message = own.removeprefix("Input should be ")
        message = message if message.startswith("must") else f"must be {message}"
        shown = repr(value)
        return cls(f"'{key}' {message}, got {shown if len(shown) <= 80 else shown[:77] + '...'}")


class InputFileError(PhasemarkError, ValueError):
    """An input file that is missing, damaged or not what it should be (exit code 3)."""

    exit_code = 3


class OutputExistsError(PhasemarkError):
    """An output that exists already, is locked, or does not fit what is being resumed (exit code 4)."""

    exit_code = 4


class StorageError(PhasemarkError):
    """The disk is full or fails (exit code 5)."""

    exit_code = 5
