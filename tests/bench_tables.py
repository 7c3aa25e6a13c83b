"""Tables of a run and of a roll test, as a laboratory keeps them, of one simulated tool."""

import numpy as np

from bench_support import Stand

SECOND = "Azimut 2 (°);"
HEAD = (
    "Nr;Gx (V);Gy (V);Gz (V);Hx (V);Hy (V);Hz (V);Temp (°C);Neigung (°);Azimut (°);"
    f"{SECOND}Rollwinkel (°);Btot (nT)"
)
RUN = [
    (inclination, float(azimuth), azimuth + 10.0)
    for inclination in (5.0, 45.0, 90.0, 135.0)
    for azimuth in range(0, 360, 45)
]
ROLLS = [(60.0, 30.0, float(face)) for face in range(0, 360, 30)]


def laboratory_table(stand: Stand, attitudes, clear=False):
    """Text with decimal commas; the azimuth stands in two columns that differ a little, unless it is to be `clear`."""
    lines = ["Tool;;T-77", "", HEAD.replace(SECOND, "") if clear else HEAD]
    rng = np.random.default_rng(1)
    for number, attitude in enumerate(attitudes, 1):
        raw = np.mean(
            [[float(v) for v in stand.line(attitude).split(",")[1:]] for _ in range(20)], 0
        )
        inc, azi, face = attitude
        second = [] if clear else [azi + float(rng.normal(0, 0.3))]
        cells = [*raw[:6], raw[6], inc, azi, *second, face, 50_000.0]
        lines.append(f"{number};" + ";".join(f"{v:.6f}".replace(".", ",") for v in cells))
    return ("\n".join(lines) + "\n").encode("cp1252")
