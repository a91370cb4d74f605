"""Times of day that go on after midnight."""

import numpy as np

DAY_S = 86400.0  # s
NEAR_S = 60.0  # s; a recording over midnight has rows this near to it on both sides


def after_midnight(t: np.ndarray) -> np.ndarray:
    """Times of day [n] s, those after midnight a day later.

    A recording goes over midnight if it has rows just before and just after; it then
    begins after the longest time without rows. One that fills the day stays as it is.
    """
    times = np.unique(t)
    if times.size < 2:
        return t
    midnight = np.floor(times[0] / DAY_S) * DAY_S
    early, late = times[0] - midnight, DAY_S - (times[-1] - midnight)
    pauses = np.diff(times)
    longest = int(np.argmax(pauses))
    if max(early, late) > NEAR_S or not NEAR_S < pauses[longest] < DAY_S:
        return t
    return np.where(t <= times[longest], t + DAY_S, t)
