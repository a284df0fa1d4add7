"""The error of sim_bridge that a user can cause."""

from __future__ import annotations

from fieldkit.errors import FieldkitError


class SynthesisError(FieldkitError):
    """A session that cannot be synthesized as asked."""
