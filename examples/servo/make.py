"""Make the bundled example: a SIMULATED servo instrument within Moosavi's Table 1.

Writes run.csv (48 stations), rolltest.csv (12 toolfaces at 45°, taken separately) and
truth.json beside this script. Same seed, same bytes.

    python examples/servo/make.py
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import mwdcal

HERE = Path(__file__).parent
SEED = 20160620
IDENTITY = {
    "serial": "SIM-0001",
    "simulated": "yes: Moosavi Table 1 servo instrument, seed 20160620",
    "operator": "examples/servo/make.py",
    "stand": "simulated, 0.01° inclination, 0.05° azimuth, 0.02° toolface",
}
POWERS = np.array([1.0, 1e-3, 1e-6])
"""Of a drift, shares of the powers 1 to 3 of temperature, per °C."""


def factors(rng, scale, bias, alignment, scale_drift, bias_drift):
    """SF (3 × 4) and B (3 × 4) by power of T - 30 °C, and m (6), within their limits."""
    gain = 1 + rng.uniform(-scale, scale, (3, 1)), scale_drift * rng.uniform(-1, 1, (3, 3)) * POWERS
    offset = rng.uniform(-bias, bias, (3, 1)), bias_drift * rng.uniform(-1, 1, (3, 3)) * POWERS
    linear = [np.concatenate(parts, -1).ravel() for parts in (gain, offset)]
    return np.concatenate([*linear, rng.uniform(-alignment, alignment, 6)])


def main() -> None:
    """Simulate both runs and write them."""
    rng = np.random.default_rng(SEED)
    profile = mwdcal.load_profile(HERE / "tool.toml")
    stand = profile.stand
    tool = (
        factors(rng, 0.05, 0.010, 2e-3, 180e-6, 100e-6),
        factors(rng, 0.02, 500.0, 4e-3, 100e-6, 2.0),
    )
    plans = {
        "run.csv": ([5, 45, 90, 135], 12, [0, 90, 180, 270], [25.0]),
        "rolltest.csv": ([45], 12, [60], [25.2]),
    }
    for name, plan in plans.items():
        run = mwdcal.simulate(
            *plan,
            tool=tool,
            stand_deg=(stand.inclination_deg, stand.azimuth_deg, stand.toolface_deg),
            drift=0.3,
            seed=rng,
        )
        logged = replace(run, temperature=np.round(run.temperature, 2), metadata=IDENTITY)
        mwdcal.save(logged, HERE / name, profile, decimals=6)
    document = {
        "simulated": True,
        "seed": SEED,
        "notation": "factors of nominal readings in tool axes, order 3: SF (3 × 4), B (3 × 4), m (6)",
        "reference_temperature_c": 30.0,
        "accelerometer": tool[0].tolist(),
        "magnetometer": tool[1].tolist(),
        "earth": {
            "gravity_g": float(run.known["gravity"][0]),
            "field_nt": float(run.known["field"][0]),
            "dip_deg": float(np.degrees(run.known["dip"][0])),
        },
    }
    (HERE / "truth.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
