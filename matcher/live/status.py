"""Status of a live session: what comes, what is accepted and what is not, and how long it takes."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_WINDOW_S = 3.0
"""Time over which rates, shares and latencies are taken."""


@dataclass
class Status:
    """Counters of a session.

    Parameters
    ----------
    source : str
        Name of the source.
    frames, accepted, dropped, damaged : int
        Frames that were matched, poses that were published, frames that newer ones replaced, and frames that were
        incomplete or garbled.
    fault : str
        What is wrong with the source or a sink now; empty if nothing is.
    """

    source: str
    frames: int = 0
    accepted: int = 0
    dropped: int = 0
    damaged: int = 0
    fault: str = ""
    reason: str = "searching"
    _recent: deque[tuple[float, str, float, bool]] = field(default_factory=deque)

    def note(self, reason: str, latency_s: float, tracked: bool) -> None:
        """Count a frame; an empty reason is that of an accepted pose."""
        self.frames += 1
        self.accepted += not reason
        self.reason = reason
        now = time.monotonic()
        self._recent.append((now, reason, latency_s, tracked))
        while self._recent and now - self._recent[0][0] > _WINDOW_S:
            self._recent.popleft()

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and text, valid JSON."""
        now = time.monotonic()
        recent = [own for own in self._recent if now - own[0] <= _WINDOW_S]
        latency = 1e3 * np.array([own[2] for own in recent])
        reasons = Counter(own[1] for own in recent if own[1])
        return {
            **{name: getattr(self, name) for name in ("source", "frames", "accepted", "dropped", "damaged")},
            "rate_hz": round(len(recent) / _WINDOW_S, 1),
            "accepted_share": round(sum(not own[1] for own in recent) / max(len(recent), 1), 3),
            "tracked_share": round(sum(own[3] for own in recent) / max(len(recent), 1), 3),
            "latency_ms": round(float(np.median(latency)), 1) if recent else None,
            "latency_p99_ms": round(float(np.quantile(latency, 0.99)), 1) if recent else None,
            "reason": self.reason,
            "reasons": dict(reasons.most_common(3)),
            "fault": self.fault,
        }

    def line(self) -> str:
        """Return the status as one line."""
        facts = self.as_dict()
        parts = [f"{facts['rate_hz']:.1f}/s"]
        if facts["latency_ms"] is not None:
            parts.append(f"latency {facts['latency_ms']:.0f} ms (p99 {facts['latency_p99_ms']:.0f})")
        parts.append(f"accepted {100 * facts['accepted_share']:.0f} %")
        parts += [f"{facts[name]} {name}" for name in ("dropped", "damaged") if facts[name]]
        if facts["reasons"]:
            parts.append("not: " + ", ".join(f"{n} {reason}" for reason, n in facts["reasons"].items()))
        if self.fault:
            parts.append(self.fault)
        return ", ".join(parts)
