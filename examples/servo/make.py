"""Make the bundled example: a SIMULATED servo instrument within Moosavi's Table 1.

Writes run.csv (48 stations), rolltest.csv (12 toolfaces at 45°, taken separately) and
truth.json beside this script. Same seed, same bytes.

    python examples/servo/make.py
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from mwdcal.files.formats import table
from mwdcal.files.profiles import load_profile
from mwdcal.files.runs import from_readings
from mwdcal.planning.simulate import grid, run, servo

HERE = Path(__file__).parent
SEED = 20160620
IDENTITY = {
    "serial": "SIM-0001",
    "simulated": "yes: Moosavi Table 1 servo instrument, seed 20160620",
    "operator": "examples/servo/make.py",
    "stand": "simulated, 0.01° inclination, 0.05° azimuth, 0.02° toolface",
}


def logged(name, values):
    """Numbers as a logger keeps them: microvolts, hundredths of a degree Celsius."""
    if name == "station":
        return values
    return np.round(values, 2 if name == "temperature_c" else 6)


def main() -> None:
    """Simulate both runs and write them."""
    rng = np.random.default_rng(SEED)
    profile, _ = load_profile(str(HERE / "tool.toml"))
    truth = servo(rng)
    stand = tuple(
        np.radians(
            [profile.stand.inclination_deg, profile.stand.azimuth_deg, profile.stand.toolface_deg]
        )
    )
    plans = {
        "run.csv": grid([5, 45, 90, 135], 12, [0, 90, 180, 270], [25.0]),
        "rolltest.csv": grid([45], 12, [60], [25.2]),
    }
    for name, plan in plans.items():
        drift = 0.3 * np.linspace(-0.5, 0.5, len(plan.temperature))
        plan = replace(plan, temperature=plan.temperature + drift)
        readings = run(truth, plan, rng, stand=stand)
        written = from_readings(readings, profile, IDENTITY)
        columns = {key: logged(key, values) for key, values in written.columns.items()}
        table.write(HERE / name, replace(written, columns=columns))
    earth = {
        "gravity_g": truth.gravity,
        "field_nt": truth.field,
        "dip_deg": float(np.degrees(truth.dip)),
    }
    document = {
        "simulated": True,
        "seed": SEED,
        "notation": "factors of nominal readings in tool axes, order 3: SF (3 × 4), B (3 × 4), m (6)",
        "reference_temperature_c": truth.reference,
        "accelerometer": truth.accelerometer.tolist(),
        "magnetometer": truth.magnetometer.tolist(),
        "earth": earth,
    }
    (HERE / "truth.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
