"""Make the bundled example: a SIMULATED servo instrument within Moosavi's Table 1.

Writes beside this script what `mwdcal example` hands out, and truth.json. Same seed, same bytes.

run.csv       48 stations
rolltest.csv  12 toolfaces at 45°, taken separately
surveys.csv   readings without references, to be corrected
well.csv      surveys of a well, with measured depths
export.csv    the stations of run.csv as a German spreadsheet program would export them
log.csv       a continuous log in which the tool rests six times
static.csv    a continuous log of the tool at rest

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
IDENTITY_LINES = [f"# {k} = {json.dumps(v, ensure_ascii=False)}\n" for k, v in IDENTITY.items()]
POWERS = np.array([1.0, 1e-3, 1e-6])
"""Of a drift, shares of the powers 1 to 3 of temperature, per °C."""
RAW = ("ax", "ay", "az", "mx", "my", "mz")
DEPTHS = list(range(0, 1080, 30))
"""Measured depths of the surveys of a well, m."""
SAMPLING_HZ = 10
SAMPLE_NOISE = 1e-3
"""Of one sample of a log, V."""


def factors(rng, scale, bias, alignment, scale_drift, bias_drift):
    """SF (3 × 4) and B (3 × 4) by power of T - 30 °C, and m (6), within their limits."""
    gain = 1 + rng.uniform(-scale, scale, (3, 1)), scale_drift * rng.uniform(-1, 1, (3, 3)) * POWERS
    offset = rng.uniform(-bias, bias, (3, 1)), bias_drift * rng.uniform(-1, 1, (3, 3)) * POWERS
    linear = [np.concatenate(parts, -1).ravel() for parts in (gain, offset)]
    return np.concatenate([*linear, rng.uniform(-alignment, alignment, 6)])


def channels(run, profile):
    """The raw channels of a run (n, 6), V: all lie along the tool axes."""
    triads = (
        run.accelerometer * profile.accelerometer.scale,
        run.magnetometer * profile.magnetometer.scale,
    )
    return np.concatenate(triads, -1)


def export(run) -> None:
    """The stations with semicolons, decimal commas and vendor names: mg and nT, x along the tool."""
    names = [
        "Messpunkt",
        "Temperatur (°C)",
        *(f"G{i} (mg)" for i in "xyz"),
        *(f"H{i} (nT)" for i in "xyz"),
    ]
    names += ["Neigung Soll (°)", "Azimut Soll (°)", "Rollwinkel Soll (°)", "Gesamtfeld Soll (nT)"]
    angles = [np.degrees(run.known[name]) for name in ("inclination", "azimuth", "toolface")]
    turned = np.roll(run.accelerometer * 1e3, 1, -1), np.roll(run.magnetometer, 1, -1)
    rows = np.column_stack(
        [run.temperature, *turned, *angles, run.known["field"] + np.zeros(run.count)]
    )
    with (HERE / "export.csv").open("w", encoding="cp1252", newline="\r\n") as stream:
        stream.writelines(IDENTITY_LINES)
        stream.write(";".join(names) + "\n")
        for label, row in enumerate(rows, 1):
            stream.write(
                f"{label};" + ";".join(f"{cell:.2f}".replace(".", ",") for cell in row) + "\n"
            )


def log(name: str, level, rng) -> None:
    """A continuous log: the level of every channel at each sample, V, with white noise."""
    level = level + SAMPLE_NOISE * rng.normal(size=level.shape)
    with (HERE / name).open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(IDENTITY_LINES)
        stream.write(",".join(["time_s", *RAW]) + "\n")
        for index, sample in enumerate(level):
            stream.write(
                f"{index / SAMPLING_HZ:.1f}," + ",".join(f"{v:.4f}" for v in sample) + "\n"
            )


def well(tool, rng, profile) -> None:
    """Surveys every 30 m of a hole that builds to 70° and turns to the east, with the Earth's field and declination."""
    inclinations = [min(max(0.08 * (depth - 120), 0.5), 70.0) for depth in DEPTHS]
    azimuths = [20 + 0.06 * max(depth - 600, 0) for depth in DEPTHS]
    rolled = mwdcal.simulate(inclinations, 5, azimuths, [25.1], tool=tool, seed=rng)
    place = np.arange(len(DEPTHS))
    run = rolled.select(np.isin(np.arange(rolled.count), 5 * place + (2 * place) % 5))
    known = {name: run.known[name] for name in ("gravity", "field", "dip")}
    identity = {**IDENTITY, "declination_deg": 2.4}
    labels = tuple(str(i + 1) for i in place)
    run = replace(run, known=known, sd={}, station=labels, metadata=identity)
    mwdcal.save(run, HERE / "well.csv", profile, decimals=6)
    depths = iter(["md_m", *map(str, DEPTHS)])
    lines = (HERE / "well.csv").read_text("utf-8").splitlines()
    lines = [line if line.startswith("#") else f"{next(depths)},{line}" for line in lines]
    (HERE / "well.csv").write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def main() -> None:
    """Simulate the runs and logs and write them."""
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
        "surveys.csv": ([20, 60, 88], 4, [30, 75, 120], [25.1]),
    }
    runs = {}
    for name, plan in plans.items():
        run = mwdcal.simulate(
            *plan,
            tool=tool,
            stand_deg=(stand.inclination_deg, stand.azimuth_deg, stand.toolface_deg),
            settings=stand.settings,
            drift=0.3,
            seed=rng,
        )
        logged = replace(run, temperature=np.round(run.temperature, 2), metadata=IDENTITY)
        runs[name] = logged
        surveys = name == "surveys.csv"
        mwdcal.save(
            replace(logged, known={}, sd={}) if surveys else logged,
            HERE / name,
            profile,
            decimals=6,
        )
    export(runs["run.csv"])
    rests = channels(runs["surveys.csv"], profile)[::2]
    seconds = np.cumsum([0, *[8, 3] * len(rests)])[:-1]
    time = np.arange(0, seconds[-1], 1 / SAMPLING_HZ)
    moving = [np.interp(time, seconds, np.repeat(channel, 2)) for channel in rests.T]
    log("log.csv", np.stack(moving, -1), rng)
    log("static.csv", np.tile(rests[0], (120 * SAMPLING_HZ, 1)), rng)
    well(tool, rng, profile)
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
