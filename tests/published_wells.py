"""ISCWSA's example wells 2 and 3: corners of their paths, and published covariances at their ends.

Figures of the ISCWSA error model diagnostics, Rev 5.1, MWD+SRGM: NN, EE, VV, NE, NV, EV of each term, m².
"""

from __future__ import annotations

import numpy as np

from mwdcal.geometry.vectors import Array

FOOT = 0.3048
CORNERS = {
    2: [
        (0, 0, 0), (2000 * FOOT, 0, 0), (3600 * FOOT, 32, 2), (5000 * FOOT, 32, 2), (5525.54 * FOOT, 32, 32),
        (6051.08 * FOOT, 32, 62), (6576.62 * FOOT, 32, 92), (7102.16 * FOOT, 32, 122), (9398.50 * FOOT, 60, 220),
        (12500 * FOOT, 60, 220),
    ],
    3: [
        (0, 0, 0), (500, 0, 0), (1100, 50, 0), (1700, 50, 0), (2450, 0, 0), (2850, 0, 0), (3030, 90, 283),
        (3430, 90, 283), (3730, 110, 193), (4030, 110, 193),
    ],
}  # fmt: skip
"""Measured depth, m, inclination and azimuth, degrees, where the path changes; arcs lead from one to the next."""
STEPS = {2: 100 * FOOT, 3: 30.0}
"""Distance of the stations, m, beside the corners."""
EARTH = {2: (48_000.0, 58.0, 2.0), 3: (61_000.0, -70.0, 13.0)}
"""Field, nT, dip and declination, degrees; gravity is 9.80665 m/s²."""
PUBLISHED = {2: """
DRFR 0.0609 0.0457 0.0320 0.0463 -0.0409 -0.0323
DSFS 0.0835 0.0307 2.8067 0.0506 -0.4840 -0.2935
DSTG 0.6451 0.1731 4.1245 0.3342 -1.6312 -0.8449
ABXY-TI1S 0.4452 0.0032 0.2949 -0.0379 -0.3624 0.0308
ABXY-TI2S 0.0852 0.2800 0.0000 -0.1544 0.0000 0.0000
ABZ 0.0501 0.0810 0.2935 -0.0637 -0.1212 0.1542
ASXY-TI1S 0.0239 0.0093 0.0901 -0.0149 -0.0464 0.0290
ASXY-TI2S 0.0119 0.0047 0.0450 -0.0075 -0.0232 0.0145
ASXY-TI3S 0.0372 0.1552 0.0000 -0.0760 0.0000 0.0000
ASZ 0.0477 0.0186 0.1802 -0.0298 -0.0927 0.0580
MBXY-TI1S 1.2493 0.4580 0.0000 -0.7564 0.0000 0.0000
MBXY-TI2S 2.1998 13.1661 0.0000 -5.3817 0.0000 0.0000
MBZ 1.5325 1.2185 0.0000 -1.3665 0.0000 0.0000
MSXY-TI1S 0.0639 0.0099 0.0000 -0.0251 0.0000 0.0000
MSXY-TI2S 0.4221 0.2693 0.0000 -0.3371 0.0000 0.0000
MSXY-TI3S 0.5214 1.0446 0.0000 -0.7380 0.0000 0.0000
MSZ 0.1278 0.0197 0.0000 -0.0502 0.0000 0.0000
DEC-U 0.7630 2.0754 0.0000 -1.2584 0.0000 0.0000
DEC-OS 1.7168 4.6697 0.0000 -2.8314 0.0000 0.0000
DEC-OH 1.3145 3.5752 0.0000 -2.1678 0.0000 0.0000
DEC-OI 0.0745 0.2027 0.0000 -0.1229 0.0000 0.0000
DECR 0.0413 0.0786 0.0000 -0.0391 0.0000 0.0000
DBH-U 0.2544 0.6920 0.0000 -0.4196 0.0000 0.0000
DBH-OS 0.5198 1.4138 0.0000 -0.8572 0.0000 0.0000
DBH-OH 0.3716 1.0106 0.0000 -0.6128 0.0000 0.0000
DBH-OI 0.0058 0.0159 0.0000 -0.0096 0.0000 0.0000
DBHR 0.0574 0.1094 0.0000 -0.0543 0.0000 0.0000
AMIL 15.1377 12.0359 0.0000 -13.4980 0.0000 0.0000
SAGE 0.0174 0.0762 37.4543 0.0364 -0.8068 -1.6895
XYM1 0.0895 0.0094 5.3744 0.0291 0.6934 0.2253
XYM2 0.2981 0.8107 0.0000 -0.4916 0.0000 0.0000
XYM3E 1.7862 0.0176 0.3449 -0.0484 0.0042 -0.0364
XYM4E 0.0176 1.9627 0.1685 -0.0563 -0.0384 -0.0567
XCLA 1.1522 1.9429 0.0000 -0.2537 0.0000 0.0000
XCLH 0.9724 0.1468 0.5837 0.1156 0.0959 0.0967
TOTAL 32.1977 47.8329 51.7927 -31.1482 -2.8537 -2.3450
""", 3: """
DRFR 0.1265 0.0368 0.0403 0.0104 0.0371 0.0221
DSFS 0.1632 0.1958 1.8316 -0.1788 0.5467 -0.5989
DSTG 0.2995 0.2390 2.6517 -0.2675 0.8912 -0.7961
ABXY-TI1S 0.7416 0.0665 0.0694 -0.2220 -0.2269 0.0679
ABXY-TI2S 0.0377 6.8750 0.0000 -0.5093 0.0000 0.0000
ABZ 0.1268 0.0498 0.4717 0.0795 0.2446 0.1533
ASXY-TI1S 0.0316 0.0202 0.0149 -0.0252 -0.0217 0.0173
ASXY-TI2S 0.0158 0.0101 0.0074 -0.0126 -0.0108 0.0087
ASXY-TI3S 0.0152 0.8255 0.0000 -0.1121 0.0000 0.0000
ASZ 0.0632 0.0403 0.0298 -0.0505 -0.0433 0.0346
MBXY-TI1S 0.0090 0.4353 0.0000 0.0624 0.0000 0.0000
MBXY-TI2S 0.3813 21.2943 0.0000 -2.8494 0.0000 0.0000
MBZ 4.6635 0.4623 0.0000 1.4683 0.0000 0.0000
MSXY-TI1S 0.0129 0.0560 0.0000 0.0269 0.0000 0.0000
MSXY-TI2S 0.0015 0.3521 0.0000 -0.0229 0.0000 0.0000
MSXY-TI3S 0.2035 7.9120 0.0000 -1.2688 0.0000 0.0000
MSZ 0.0258 0.1119 0.0000 0.0538 0.0000 0.0000
DEC-U 4.8694 4.0581 0.0000 4.4453 0.0000 0.0000
DEC-OS 10.9562 9.1308 0.0000 10.0019 0.0000 0.0000
DEC-OH 8.3883 6.9907 0.0000 7.6577 0.0000 0.0000
DEC-OI 0.4755 0.3963 0.0000 0.4341 0.0000 0.0000
DECR 0.0592 0.0887 0.0000 -0.0022 0.0000 0.0000
DBH-U 2.4133 2.0112 0.0000 2.2031 0.0000 0.0000
DBH-OS 4.9305 4.1090 0.0000 4.5011 0.0000 0.0000
DBH-OH 3.5246 2.9374 0.0000 3.2176 0.0000 0.0000
DBH-OI 0.0554 0.0462 0.0000 0.0506 0.0000 0.0000
DBHR 0.1224 0.1834 0.0000 -0.0046 0.0000 0.0000
AMIL 46.0635 4.5666 0.0000 14.5035 0.0000 0.0000
SAGE 23.9440 0.0030 47.1868 -0.2687 -33.6131 0.3771
XYM1 2.4417 0.0003 8.6357 0.0261 -4.5919 -0.0490
XYM2 1.9021 1.5852 0.0000 1.7364 0.0000 0.0000
XYM3E 1.6014 0.0064 0.2948 0.0027 -0.3696 -0.0125
XYM4E 0.0064 1.8717 0.0245 -0.0089 -0.0043 0.0308
XCLA 3.2785 2.8965 0.0000 -1.7127 0.0000 0.0000
XCLH 1.8029 4.0926 6.9540 -0.9355 -1.4081 3.0713
TOTAL 123.7537 83.9572 68.2125 42.0298 -38.5701 2.3267
"""}  # fmt: skip


def stations(well: int) -> tuple[Array, Array, Array]:
    """Depth, inclination and true azimuth (n,), m and rad; angles in hundredths of a degree, as they are published."""
    corners = np.array(CORNERS[well], float)
    depths = np.arange(0, corners[-1, 0] + 1e-6, STEPS[well])
    md = np.unique(np.round(np.concatenate([depths, corners[:, 0]]), 6))
    i, a = np.radians(corners[:, 1:]).T
    ends = np.stack([np.sin(i) * np.cos(a), np.sin(i) * np.sin(a), np.cos(i)], -1)
    angles = []
    for depth in md:
        k = min(int(np.searchsorted(corners[:, 0], depth, "right")) - 1, len(corners) - 2)
        share = (depth - corners[k, 0]) / (corners[k + 1, 0] - corners[k, 0])
        bend = np.arccos(np.clip(ends[k] @ ends[k + 1], -1, 1))
        first, second = 1 - share, share
        if bend > 1e-9:
            first, second = (np.sin(w * bend) / np.sin(bend) for w in (first, second))
        x, y, z = first * ends[k] + second * ends[k + 1]
        across = np.hypot(x, y)
        angles.append(
            (np.arctan2(across, z), np.arctan2(y, x) % (2 * np.pi) if across > 1e-9 else 0)
        )
    inclination, azimuth = np.radians(np.round(np.degrees(angles), 2)).T
    return md, inclination, azimuth


def published(well: int) -> dict[str, Array]:
    """Covariances (6,) at the end of a well by term, and their total, to four decimals."""
    rows = (line.split() for line in PUBLISHED[well].strip().splitlines())
    return {name: np.array(values, float) for name, *values in rows}
