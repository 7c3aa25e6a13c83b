"""How soon the bench takes a simulated tool for settled, and what the `sd_` of its stations cover.

    python examples/bench/standstills.py

For each noise and rate of samples: the share of standstills that had settled in time, how often the tool was called
settled while it moved, the share of means within ±1.96 `sd_` of the truth, and how often the page says that the noise
wanders. The table of `docs/tutorials/bench.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.signal import lfilter

from mwdcal.bench.settling import Settling, Standstill
from mwdcal.files.contract import RAW
from mwdcal.logs.stations import means_of

NOISES = {
    "white": 0.0,
    "white, steps of 5": 0.0,
    "AR(1), 0.05 s": 0.05,
    "AR(1), 0.3 s": 0.3,
    "AR(1), 0.3 s, steps of 5": 0.3,
    "AR(1), 1 s": 1.0,
    "AR(1), 5 s": 5.0,
}
"""Kinds of noise of standard deviation 1, and their correlation times, seconds."""
RATES, WINDOW, MOVE, LONGEST, SEEDS, STATIONS = (5, 10, 50, 100), 5.0, 4, 40, range(2000, 2004), 24
STILL_MOVING = 1.5
"""Seconds into a move from which on "settled" is wrong: until then the latest cell may be from before."""


def noise(rng: np.random.Generator, count: int, rate: int, seconds: float) -> Any:
    """Samples (count, 6) of white or AR(1) noise of variance 1."""
    white = rng.normal(size=(count, len(RAW)))
    share = np.exp(-1 / rate / seconds) if seconds else 0.0
    start = share * rng.normal(size=(1, len(RAW)))
    return lfilter([np.sqrt(1 - share**2)], [1, -share], white, axis=0, zi=start)[0]


def session(
    seed: int, rate: int, kind: str
) -> Iterator[tuple[float, int, bool, Standstill | None, Any]]:
    """Of each station: seconds until it settled, false calls, whether it wanders, the standstill, the truth (6,)."""
    rng, judge, clock = np.random.default_rng(seed), Settling(len(RAW), WINDOW), 0.0
    here = rng.normal(size=len(RAW)) * 1000
    for _ in range(STATIONS):
        goal, moving = rng.normal(size=len(RAW)) * 1000, MOVE * rate
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(moving) / moving)
        still = np.tile(goal, (LONGEST * rate, 1))
        values = np.concatenate([here + share[:, None] * (goal - here), still])
        values = values + noise(rng, len(values), rate, NOISES[kind])
        values = np.round(values / 5) * 5 if "steps" in kind else values
        false, found, waited = 0, None, np.inf
        for place, row in enumerate(values.tolist()):
            judge.take(clock, row)
            clock += 1 / rate
            if judge.state != "settled":
                continue
            false += STILL_MOVING * rate < place < moving
            if place >= moving:
                found, waited = judge.station(), (place - moving) / rate
                break
        here = goal
        yield waited, false, judge.wanders, found, goal


def main() -> None:
    """Print a line for each noise and rate."""
    for rate in RATES:
        for kind in NOISES:
            waits, false, wanders, errors = [], 0, [], []
            for seed in SEEDS:
                stations = [*session(seed, rate, kind)]
                waits += [each[0] for each in stations]
                false += sum(each[1] for each in stations)
                wanders += [each[2] for each in stations]
                there = [(still, goal) for *_, still, goal in stations if still is not None]
                rests = {
                    n: [(s.time, s.samples[:, k]) for s, _ in there] for k, n in enumerate(RAW)
                }
                rows = means_of(rests, dict(zip(RAW, there[-1][0].steps, strict=True)))
                errors += [
                    (rows[n].mean - [g[k] for _, g in there]) / rows[n].sd
                    for k, n in enumerate(RAW)
                ]
            wait, error = np.array(waits), np.concatenate(errors)
            soon, later = (100 * np.mean(wait <= limit) for limit in (6, 12))
            print(
                f"{kind:24s} {rate:4d} Hz  settled within 6 s {soon:3.0f} %, 12 s {later:3.0f} %  moving {false}  "
                f"covers {100 * np.mean(np.abs(error) < 1.96):3.0f} %  rms {np.sqrt(np.mean(error**2)):.2f}  "
                f"wanders {100 * np.mean(wanders):3.0f} %",
                flush=True,
            )


if __name__ == "__main__":
    main()
