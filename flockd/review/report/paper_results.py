"""The paper's own results: five UAVs from Table 1, 110 s, a step every 0.5 s, images of 640x480."""

from __future__ import annotations

from typing import Final

TABLE_2: Final = {
    "before": {
        "translation_x_m": 0.1518,
        "translation_y_m": 0.2324,
        "yaw_deg": 1.8459,
        "pitch_deg": 1.7812,
        "roll_deg": 1.5739,
        "distance_m": 0.1683,
    },
    "after": {
        "translation_x_m": 0.0099,
        "translation_y_m": 0.0155,
        "yaw_deg": 0.7560,
        "pitch_deg": 0.6231,
        "roll_deg": 0.7804,
        "distance_m": 0.0333,
    },
}
"""Maximum errors before and after the circle ends at 66 s."""

TABLE_3: Final = {
    "truth": {"obj1": {"time_s": 67.0, "error": 0.0000}, "obj2": {"time_s": 67.0, "error": 0.0206}},
    "vision": {"obj1": {"time_s": 67.0, "error": 0.0000}, "obj2": {"time_s": 67.0, "error": 0.1273}},
}
"""When the sums of Eq. 44 and 45 over the flock converge, and to within what."""
