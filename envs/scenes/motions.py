"""Motions of obstacles as plain data: oscillations, timed waypoints, appearing and disappearing.

    from roboarm_nmp.envs.scenes.motions import Oscillation, Presence, Waypoints

    Box((0.5, 0.0, 0.3), (0.1, 0.1, 0.1), motion=Oscillation((0.0, 0.2, 0.0), period=4.0))
    # It waits for 1 s, visits a place 0.3 m to the left for 1 s, and is gone from 5 s on.
    visit = Waypoints((1.0, 2.0, 3.0, 4.0), ((0, 0, 0), (0, 0.3, 0), (0, 0.3, 0), (0, 0, 0)))
    Box((0.5, 0.0, 0.3), (0.1, 0.1, 0.1), motion=Presence(((0.0, 5.0),), visit))

Time is in seconds since the start of an episode. A motion moves an obstacle away from its own pose:
at each time it gives a displacement, m, along the axes of the robot's base, and a rotation about
the obstacle's own position, a quaternion (x, y, z, w) in the same axes.
"""

import bisect
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from roboarm_nmp.envs.scenes.numbers import (
    IDENTITY,
    MAX_LENGTH,
    Quaternion,
    Vector,
    is_number,
    multiply,
    unit_quaternion,
)

# Faster motions are rejected: in a physics step of 1/120 s an obstacle would move by more than
# 4 cm, and through a link without any contact.
MAX_SPEED = 5.0
"""m/s."""
MAX_ANGULAR_SPEED = 20.0
"""rad/s."""
MIN_SECONDS = 1e-3
"""s, the least period, and time from one waypoint to the next."""
MAX_TIME = 1e6
"""s, the largest of all times."""
MAX_WAYPOINTS = 1_000
MAX_INTERVALS = 1_000
ONCE = "once"
BACK_AND_FORTH = "back_and_forth"
CYCLIC = "cyclic"
REPEATS = (ONCE, BACK_AND_FORTH, CYCLIC)
# Cyclic waypoints end where they begin, up to this (m, and of a quaternion's components).
_CLOSED = 1e-6


@dataclass(frozen=True)
class Oscillation:
    """A sinusoidal motion through an obstacle's own pose: sin(2 pi t / period + phase).

    Args:
        amplitude: m, (x, y, z): the largest displacement.
        period: s, at least `MIN_SECONDS`.
        phase: rad; 0 begins at the obstacle's own pose.
        axis: (x, y, z), of any length but 0, about which the obstacle turns.
        angle: rad, the largest rotation.

    Raises ValueError: a number is not finite or too large, the period is too short, the axis is
    zero, or the motion exceeds `MAX_SPEED` or `MAX_ANGULAR_SPEED`.
    """

    amplitude: Vector = (0.0, 0.0, 0.0)
    period: float = 1.0
    phase: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)
    angle: float = 0.0

    def __post_init__(self):
        for name in ("amplitude", "axis"):
            _set(self, name, _vector(f"the {name} of an oscillation", getattr(self, name)))
        for name in ("period", "phase", "angle"):
            _set(self, name, _number(f"the {name} of an oscillation", getattr(self, name)))
        if self.period < MIN_SECONDS:
            raise ValueError(
                f"the period of an oscillation must be at least {MIN_SECONDS} s, got {self.period}"
            )
        norm = math.hypot(*self.axis)
        if norm < 1e-6:
            raise ValueError("the axis of an oscillation must not be zero")
        if abs(norm - 1) > 1e-9:  # otherwise it stays as it is, bit for bit
            _set(self, "axis", tuple(number / norm for number in self.axis))
        frequency = 2 * math.pi / self.period
        _check_speed("an oscillation", math.hypot(*self.amplitude) * frequency)
        _check_angular_speed("an oscillation", abs(self.angle) * frequency)

    def pose(self, t: float) -> tuple[Vector, Quaternion]:
        """Displacement (3), m, and rotation (4) at a time (s)."""
        share = math.sin(2 * math.pi / self.period * t + self.phase)
        half = 0.5 * self.angle * share
        sine = math.sin(half)
        x, y, z = self.axis
        rotation = (x * sine, y * sine, z * sine, math.cos(half))
        a, b, c = self.amplitude
        return (a * share, b * share, c * share), rotation

    def is_present(self, t: float) -> bool:
        """Whether the obstacle is there at a time (s): always."""
        return True


@dataclass(frozen=True)
class Waypoints:
    """A motion through waypoints, at constant speed between them.

    Before the first time, the obstacle is at the first waypoint.

    Args:
        times: s, ascending, >= 0, at least `MIN_SECONDS` apart: when the obstacle is at each
            waypoint.
        displacements: m, (x, y, z) of each waypoint, from the obstacle's own position.
        rotations: a quaternion (x, y, z, w) of each; none: the obstacle does not turn. Between
            two waypoints it takes the shorter way round.
        repeat: after the last waypoint, `once`: the obstacle stays there; `back_and_forth`: it
            moves through all waypoints to the first one, then forth again, and so on; `cyclic`:
            it continues at the first waypoint, which must be equal to the last one.

    Raises ValueError: a number is not finite or too large, times do not ascend, lengths differ, a
    cycle is not closed, or the motion exceeds `MAX_SPEED` or `MAX_ANGULAR_SPEED`.
    """

    times: tuple[float, ...]
    displacements: tuple[Vector, ...]
    rotations: tuple[Quaternion, ...] = ()
    repeat: str = ONCE

    def __post_init__(self):
        count = len(self.times)
        if not 1 <= count <= MAX_WAYPOINTS:
            raise ValueError(f"a motion has 1 to {MAX_WAYPOINTS:,} waypoints, got {count}")
        _set(self, "times", tuple(_number("times of waypoints", t) for t in self.times))
        displacements = [_vector("displacements of waypoints", d) for d in self.displacements]
        _set(self, "displacements", tuple(displacements))
        rotations = [tuple(map(float, unit_quaternion(turn))) for turn in self.rotations]
        _set(self, "rotations", tuple(rotations))
        for name, rows in (("displacements", displacements), ("rotations", rotations)):
            if len(rows) != count and (rows or name == "displacements"):
                raise ValueError(f"waypoints have {count} times, but {len(rows)} {name}")
        if self.repeat not in REPEATS:
            raise ValueError(f"repeat must be one of {', '.join(REPEATS)}, got {self.repeat!r}")
        if self.times[0] < 0 or any(b - a < MIN_SECONDS for a, b in itertools.pairwise(self.times)):
            raise ValueError(
                f"times of waypoints must be at least 0, and ascend, by at least {MIN_SECONDS} s"
            )
        if self.repeat != ONCE and count == 1:
            raise ValueError(f"a motion of one waypoint cannot be {self.repeat}")
        if self.repeat == CYCLIC and not self._is_closed():
            raise ValueError("cyclic waypoints must end where they begin: add the first one again")
        for i in range(1, count):
            seconds = self.times[i] - self.times[i - 1]
            what = f"the way to waypoint {i}"
            distance = math.dist(self.displacements[i - 1], self.displacements[i])
            _check_speed(what, distance / seconds)
            if self.rotations:
                angle = _angle(self.rotations[i - 1], self.rotations[i])
                _check_angular_speed(what, angle / seconds)

    def _is_closed(self) -> bool:
        near = math.dist(self.displacements[0], self.displacements[-1]) <= _CLOSED
        return near and (not self.rotations or _angle(self.rotations[0], self.rotations[-1]) < 1e-5)

    def pose(self, t: float) -> tuple[Vector, Quaternion]:
        """As `Oscillation.pose`."""
        times = self.times
        begin = times[0]
        span = times[-1] - times[0]
        if self.repeat != ONCE and t > begin:
            t -= begin
            if self.repeat == CYCLIC:
                t -= span * math.floor(t / span)
            else:
                t -= 2 * span * math.floor(t / (2 * span))
                if t > span:
                    t = 2 * span - t
            t += begin
        if len(times) == 1:
            return self.displacements[0], self.rotations[0] if self.rotations else IDENTITY
        i = min(max(bisect.bisect_right(times, t), 1), len(times) - 1)
        share = (t - times[i - 1]) / (times[i] - times[i - 1])
        share = min(max(share, 0.0), 1.0)
        x, y, z = self.displacements[i - 1]
        u, v, w = self.displacements[i]
        displacement = (x + share * (u - x), y + share * (v - y), z + share * (w - z))
        if not self.rotations:
            return displacement, IDENTITY
        return displacement, _slerp(self.rotations[i - 1], self.rotations[i], share)

    def is_present(self, t: float) -> bool:
        """As `Oscillation.is_present`."""
        return True


@dataclass(frozen=True)
class Presence:
    """An obstacle that appears and disappears, and may move.

    Args:
        intervals: pairs of times (s), ascending: the obstacle is there from the first one of each
            pair on, until before the second one, which may be infinite.
        motion: an `Oscillation` or `Waypoints`, whose time passes also while the obstacle is not
            there; None: it does not move.

    Raises:
        ValueError: a number is not finite, or times do not ascend.
        TypeError: `motion` is of another type.
    """

    intervals: tuple[tuple[float, float], ...]
    motion: Oscillation | Waypoints | None = None

    def __post_init__(self):
        if not 1 <= len(self.intervals) <= MAX_INTERVALS:
            raise ValueError(
                f"there are 1 to {MAX_INTERVALS:,} intervals of presence, got {len(self.intervals)}"
            )
        _set(self, "intervals", tuple(map(_interval, self.intervals)))
        times = [t for interval in self.intervals for t in interval]
        if times[0] < 0 or any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("times of presence must be at least 0, and ascend")
        if not isinstance(self.motion, Oscillation | Waypoints | None):
            raise TypeError(f"motion must be Oscillation, Waypoints or None, got {self.motion!r}")

    def pose(self, t: float) -> tuple[Vector, Quaternion]:
        """As `Oscillation.pose`."""
        return _NO_MOTION if self.motion is None else self.motion.pose(t)

    def is_present(self, t: float) -> bool:
        """Whether the obstacle is there at a time (s)."""
        return any(begin <= t < end for begin, end in self.intervals)


Motion = Oscillation | Waypoints | Presence
_NO_MOTION = ((0.0, 0.0, 0.0), IDENTITY)


# --- Motions as lists of numbers, for files


def motion_to_numbers(motion: Motion | None) -> list[float]:
    """A motion as a list of floats; empty for None.

    The first number is the kind. 0, an oscillation: amplitude 3, period, phase, axis 3, angle. 1,
    waypoints: how they repeat (0 once, 1 back and forth, 2 cyclic), whether they turn, their
    number, all times, all displacements, all rotations. 2, presence: the number of intervals, their
    times, and the numbers of another motion, if any.
    """
    if motion is None:
        return []
    if isinstance(motion, Oscillation):
        return [0.0, *motion.amplitude, motion.period, motion.phase, *motion.axis, motion.angle]
    if isinstance(motion, Waypoints):
        repeat = float(REPEATS.index(motion.repeat))
        turns = 1.0 if motion.rotations else 0.0
        rows = itertools.chain(*motion.displacements, *motion.rotations)
        return [1.0, repeat, turns, float(len(motion.times)), *motion.times, *rows]
    times = itertools.chain(*motion.intervals)
    return [2.0, float(len(motion.intervals)), *times, *motion_to_numbers(motion.motion)]


def motion_from_numbers(numbers: Iterable[float]) -> Motion | None:
    """The inverse of `motion_to_numbers`. Raises ValueError: there is no such motion."""
    numbers = [float(number) for number in numbers]
    if not numbers:
        return None
    kind = numbers[0]
    if kind == 0 and len(numbers) == 10:
        _, a, b, c, period, phase, x, y, z, angle = numbers
        return Oscillation((a, b, c), period, phase, (x, y, z), angle)
    if kind == 1 and len(numbers) > 4:
        _, repeat, turns, count, *rest = numbers
        width = 8 if turns else 4
        if repeat in (0, 1, 2) and turns in (0, 1) and len(rest) == width * count:
            n = int(count)
            displacements = _rows(rest[n : 4 * n], 3)
            rotations = _rows(rest[4 * n :], 4)
            return Waypoints(tuple(rest[:n]), displacements, rotations, REPEATS[int(repeat)])
    if kind == 2 and len(numbers) > 3 and numbers[1] in range(1, (len(numbers) - 2) // 2 + 1):
        end = 2 + 2 * int(numbers[1])
        inner = numbers[end:]
        if not inner or inner[0] != 2:
            motion = motion_from_numbers(inner)
            if not isinstance(motion, Presence):
                return Presence(_rows(numbers[2:end], 2), motion)
    raise ValueError("numbers of a motion that make no sense")


def _rows(numbers: Sequence[float], width: int) -> tuple[tuple[Any, ...], ...]:
    """Numbers as rows of a width, of which their length is a multiple."""
    return tuple(tuple(numbers[i : i + width]) for i in range(0, len(numbers), width))


def _set(motion: Motion, name: str, value: Any) -> None:
    object.__setattr__(motion, name, value)


def _number(what: str, value: Any) -> float:
    if not is_number(value) or abs(value) > MAX_TIME:
        raise ValueError(f"{what} must be a finite number, at most {MAX_TIME:.0f}, got {value!r}")
    return float(value)


def _vector(what: str, value: Iterable[float]) -> tuple[float, ...]:
    value = tuple(value)
    if len(value) != 3 or not all(is_number(n) and abs(n) <= MAX_LENGTH for n in value):
        raise ValueError(f"{what} must be 3 finite numbers, up to {MAX_LENGTH:.0f}, got {value}")
    return tuple(map(float, value))


def _interval(interval: Iterable[float]) -> tuple[float, float]:
    interval = tuple(interval)
    if len(interval) != 2:
        raise ValueError(f"an interval of presence is two times, got {interval}")
    begin, end = interval
    if end != math.inf:
        end = _number("times of presence", end)
    return _number("times of presence", begin), end


def _check_speed(what: str, speed: float) -> None:
    if speed > MAX_SPEED:
        raise ValueError(f"{what} is too fast: {speed:.3g} m/s, at most {MAX_SPEED:g} m/s")


def _check_angular_speed(what: str, speed: float) -> None:
    if speed > MAX_ANGULAR_SPEED:
        raise ValueError(
            f"{what} turns too fast: {speed:.3g} rad/s, at most {MAX_ANGULAR_SPEED:g} rad/s"
        )


def _angle(a: Quaternion, b: Quaternion) -> float:
    """The angle (rad) between two orientations."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if dot < 0.0 else 1.0
    apart = math.dist(a, [sign * n for n in b])
    together = math.dist(a, [-sign * n for n in b])
    return 4 * math.atan2(apart, together)  # exact for small angles, as acos is not


def _slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """The orientation between two of them, on the shorter way."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if dot < 0.0 else 1.0
    angle = 0.5 * _angle(a, b)
    sine = math.sin(angle)
    first = 1.0 - share
    second = share
    if sine > 1e-9:
        first = math.sin(first * angle) / sine
        second = math.sin(second * angle) / sine
    second *= sign
    return (
        first * a[0] + second * b[0],
        first * a[1] + second * b[1],
        first * a[2] + second * b[2],
        first * a[3] + second * b[3],
    )


def moved(
    position: Vector, orientation: Quaternion, displacement: Vector, rotation: Quaternion
) -> tuple[Vector, Quaternion]:
    """An obstacle's own pose after a displacement (3), m, and a rotation (4)."""
    x, y, z = position
    u, v, w = displacement
    position = (x + u, y + v, z + w)
    if rotation == IDENTITY:
        return position, orientation
    return position, multiply(rotation, orientation)
