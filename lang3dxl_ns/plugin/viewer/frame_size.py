"""Frame sizes of nerfstudio's viewer: recognizable while moving, full size soon after."""

from __future__ import annotations

LEAST = (320, 180)
"""Fewest pixels of a frame while the camera moves: on a CPU the time budget alone would leave 30 rows."""


def keep_frames_recognizable() -> None:
    """Applies to all further viewers of this process."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine  # imports the models

    chosen = RenderStateMachine._calculate_image_res
    if getattr(chosen, "has_least", False):
        return

    def at_least(self: RenderStateMachine, aspect_ratio: float) -> tuple[int, int]:
        # At rest the full size follows directly, without another small frame.
        self.transitions["low_move"]["static"] = "high"
        height, width = chosen(self, aspect_ratio)
        if self.state == "high":
            return height, width
        return least_size(height, width, aspect_ratio, self.viewer.control_panel.max_res)

    at_least.has_least = True  # type: ignore[attr-defined]
    RenderStateMachine._calculate_image_res = at_least  # type: ignore[method-assign]


def least_size(height: int, width: int, aspect_ratio: float, most: int) -> tuple[int, int]:
    """Height and width enlarged to `LEAST`, if the longer side stays within `most`."""
    rows = max(height, LEAST[1], round(LEAST[0] / aspect_ratio))
    rows = min(rows, most, int(most / aspect_ratio))
    return (rows, int(rows * aspect_ratio)) if rows > height else (height, width)
