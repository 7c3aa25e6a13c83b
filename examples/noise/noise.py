"""A simulated hour of a servo tool at rest: writes the log, and the picture of docs/howto/noise.md.

Run from the repository: .venv/bin/python examples/noise/noise.py [FOLDER]
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RATE, COUNT = 50.0, 180_000
LEVEL = {"ax": 0.01, "ay": -0.02, "az": 2.99, "mx": 0.9, "my": -0.01, "mz": 2.2}
NOISE = {  # white, of one sample; random walk, a sample; bias instability: V
    "ax": (3e-4, 3e-7, 0.0),
    "ay": (3e-4, 1e-7, 6e-6),
    "az": (4e-4, 0.0, 0.0),
    "mx": (7e-4, 0.0, 2e-5),
    "my": (7e-4, 5e-7, 0.0),
    "mz": (8e-4, 1e-7, 0.0),
}


def flicker(rng: np.random.Generator, size: float) -> np.ndarray:
    """Bias instability: white noise, integrated by half (Kasdin 1995)."""
    length = 4 * COUNT
    half = np.cumprod(np.concatenate([[1.0], 1 - 0.5 / np.arange(1, length)]))
    source = np.fft.rfft(size * rng.normal(size=length), 2 * length)
    return np.fft.irfft(source * np.fft.rfft(half, 2 * length))[length - COUNT : length]


def main(folder: Path) -> None:
    """Simulate, write `static.csv`, and run the command on it."""
    rng = np.random.default_rng(2026)
    columns = []
    for name, (white, walk, bias) in NOISE.items():
        steps = np.cumsum(walk * rng.normal(size=COUNT))
        columns.append(LEVEL[name] + white * rng.normal(size=COUNT) + steps + flicker(rng, bias))
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "static.csv"
    head = f"# simulated = true\n# sampling_hz = {RATE:g}\n{','.join(LEVEL)}"
    np.savetxt(log, np.stack(columns, -1), "%.6f", ",", header=head, comments="")
    command = [sys.executable, "-m", "mwdcal", "noise", log, "--tool", "servo"]
    subprocess.run([*command, "--plot", ROOT / "docs" / "howto" / "noise.svg"], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "noise")
