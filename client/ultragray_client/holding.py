"""Whether a robot may act on a frame, or must hold still: one answer from age, deadline, confidence and contact."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray_client.errors import ClientError
from ultragray_client.frames import Frame


@dataclass(frozen=True, kw_only=True)
class HoldStill:
    """The limits of a control loop; None: no limit. `reason(...)` says why to hold still, and None to go.

        still = HoldStill(most_age_ms=50, least_confidence=0.7, least_contact=0.9)
        frame = stream.receive()
        if still.reason(frame) is None: ...  # the control law

    What a limit looks at and a frame does not tell holds, too: no confidence is not enough of it.
    """

    most_age_ms: float | None = None  # from `measured_ns` of the pose to now; needs poses that are sent with it
    least_confidence: float | None = None  # 0 to 1
    most_error_mm: float | None = None  # expected of a foretold pose; needs a stream with `seen_after_ms`
    least_trust: float | None = None  # of a preview, 0 to 1; needs a stream that real frames are sent to
    least_contact: float | None = None  # share of the scan lines, 0 to 1; needs `contact` in the settings

    def reason(self, frame: Frame | ClientError | None, *, waited_ms: float = 0.0) -> str | None:
        """Why to hold still, in a few words; None: go.

        `frame`: what came; None where none came in time, or the error that `receive` raised instead. `waited_ms`: how
        long ago it came, which adds to its age.
        """
        if frame is None:
            return "no frame in time"
        if isinstance(frame, ClientError):
            return f"no frame: {frame.reason}"
        age_ms = None if frame.latency_ms is None else frame.latency_ms + waited_ms
        extrapolation, unknown = frame.extrapolation, "is not told"
        if self.most_age_ms is not None and not (age_ms is not None and age_ms <= self.most_age_ms):
            return f"age {unknown if age_ms is None else f'of {age_ms:.0f} ms'}"
        if self.most_error_mm is not None:
            error_mm = None if frame.prediction is None else frame.prediction.error_mm
            if not (error_mm is not None and error_mm <= self.most_error_mm):
                return f"error of the pose {unknown if error_mm is None else f'of {error_mm:.2f} mm'}"
        for name, value, least in (
            ("confidence", extrapolation.confidence, self.least_confidence),
            ("trust", None if frame.preview is None else frame.preview.trust, self.least_trust),
            ("contact", extrapolation.contact_share, self.least_contact),
        ):
            if least is not None and not (value is not None and value >= least):
                return f"{name} {unknown if value is None else f'of {value:.2f}'}"
        return None
