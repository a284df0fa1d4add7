"""Errors that a user can cause: one line with path, what is wrong, what was expected, and what to do."""

from __future__ import annotations


class FieldkitError(Exception):
    """Report a user's mistake in one line; the command line prints it and exits with status 1."""

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        self.message = " ".join(message.split())
        self.hint = None if hint is None else " ".join(hint.split())
        super().__init__(self.message if self.hint is None else f"{self.message}; {self.hint}")


class FrameError(FieldkitError):
    """A pose, trajectory or covariance that cannot be used."""


class CameraError(FieldkitError):
    """A camera model or camera file that cannot be used."""


class ProtocolError(FieldkitError):
    """A protocol file with an unknown key, policy, threshold or value."""


class StoreError(FieldkitError):
    """A file or folder on disk that is missing, damaged, of a newer version, or in the way."""


class BagError(FieldkitError):
    """A recording that cannot be opened or lacks something that is needed."""


class TagError(FieldkitError):
    """A tag, tag file or tag photo that cannot be used."""


class FeatureError(FieldkitError):
    """An unknown feature, or an image from which none can be extracted."""


class WeightsError(FieldkitError):
    """A network's weight file that is missing, damaged, or of another network."""


class SurfaceError(FieldkitError):
    """A surface that is missing or cannot be made."""


class MapError(FieldkitError):
    """A map that cannot be built, aligned or read."""


class LocalizeError(FieldkitError):
    """Images or a map with which localization cannot start."""


class PolicyError(FieldkitError):
    """An unknown policy, or one that cannot run with this map."""


class PriorError(FieldkitError):
    """A recording from which no position prior can be made."""


class TruthError(FieldkitError):
    """A recording from which no ground truth can be made."""


class ScoreError(FieldkitError):
    """Results that cannot be scored."""


class ReplayError(FieldkitError):
    """Recordings, map and tags that do not fit together."""


class DatasetError(FieldkitError):
    """A dataset that cannot be made, continued or replayed as asked."""


class TrainingError(FieldkitError):
    """Scenes, labels or settings from which no policy can be trained, or an unfinished training of other ones."""


class JudgeError(FieldkitError):
    """A session folder without the truth that a judge needs."""


class ReportError(FieldkitError):
    """Results from which no report can be made."""


def suggestion(word: str, known: list[str] | tuple[str, ...]) -> str:
    """Return ``known: a, b, c`` with a guess of the word that was meant in front, when one is close."""
    import difflib

    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    guess = f"did you mean {close[0]!r}? " if close else ""
    return f"{guess}known: {', '.join(known)}"
