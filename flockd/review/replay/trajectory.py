"""The path of the camera: one motion after the other, and its file."""

from __future__ import annotations

from collections.abc import Iterable

from flockd.flight.geometry import RigidTransform, quaternion_from_rotation
from flockd.review.replay.dataset_pairs import Pair


def integrate(pairs: Iterable[Pair], stride: int) -> tuple[list[tuple[float, RigidTransform]], Pair | None]:
    """Times and camera poses (``T_world_camera``) by one motion after the other, every ``stride``-th frame.

    It begins at the first frame's true pose, or at the origin. It ends before the first motion that is not known,
    which is given too: where the camera went then is not known.
    """
    path: list[tuple[float, RigidTransform]] = []
    for pair in pairs:
        if pair.before.index % stride:
            continue
        if not path:
            path.append((pair.before.time_s, pair.before.T_world_camera or RigidTransform.identity()))
        if pair.found is None:
            return path, pair
        path.append((pair.after.time_s, path[-1][1] @ pair.found))
    return path, None


def tum_text(path: Iterable[tuple[float, RigidTransform]]) -> str:
    """The path in the TUM format: time, position, quaternion x y z w; one pose a line."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time_s, pose in path:
        numbers = (*pose.translation, *quaternion_from_rotation(pose.rotation))
        lines.append(f"{time_s:.6f} {' '.join(f'{number:.9f}' for number in numbers)}")
    return "\n".join(lines) + "\n"
