"""A stand with a tool for tests of the bench, by the independent forward model, and a bench as its own process."""

from __future__ import annotations

import contextlib
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from cli_support import SCALE
from simulation import DEG, Tool

RATE = 10.0
HEADER = "time_s,ax,ay,az,mx,my,mz,temperature_c"
NOISE = (1e-4, 15.0)
EARTH = {"gravity_g": 1.0, "field_nt": 50_000.0, "dip_deg": 65.0}


class Stand:
    """Lines of a servo tool at attitudes in degrees; its clock goes on from line to line."""

    def __init__(self, seed=3, temperature=25.0, stream=HEADER):
        self.tool = Tool.random(seed, noise=NOISE)
        self.rng = np.random.default_rng(seed)
        self.names, self.temperature, self.time = stream.split(","), temperature, 0.0
        self.here = (10.0, 20.0, 30.0)

    def line(self, attitude):
        inc, azi, face = (np.array([value * DEG]) for value in attitude)
        g, b = (v[0, 0] for v in self.tool.readings(self.rng, 1, inc, azi, face))
        raw = [*(g * SCALE[0]), *(b * SCALE[1]), self.time, self.temperature]
        values = dict(zip((*HEADER.split(",")[1:7], "time_s", "temperature_c"), raw, strict=True))
        self.time = round(self.time + 1 / RATE, 6)
        return ",".join(f"{values[name]:.8g}" for name in self.names)

    def lines(self, attitude, seconds=7.0, move=2.0):
        """A move to an attitude, and a standstill there."""
        start, end = np.array(self.here), np.array(attitude)
        self.here = tuple(attitude)
        for share in np.linspace(0, 1, int(move * RATE), endpoint=False):
            yield self.line(start + share * (end - start))
        for _ in range(int(seconds * RATE)):
            yield self.line(end)


def measure(session, stand, off=(0.0, 0.0, 0.0), **times):
    """The station that a session asks for, measured `off` the ordered angles by hand."""
    attitude = session.part.attitude(session.order)
    for line in stand.lines(tuple(np.add(attitude, off)), **times):
        session.line(0.0, line)
    for _ in range(200):
        if session.settling.state == "settled":
            break
        session.line(0.0, stand.line(stand.here))
    session.accept()


def port_free():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class StandServer:
    """A stand behind a TCP port, which goes where `order` says; `drop` closes the connection."""

    def __init__(self, speed=1.0, seed=3):
        self.stand, self.speed, self.order = Stand(seed), speed, None
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.connection, self.stopped = None, False
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        while not self.stopped:
            try:
                self.connection, _ = self.listener.accept()
                self.connection.sendall((HEADER + "\n").encode())
                while not self.stopped:
                    goal = self.order or self.stand.here
                    lines = [*self.stand.lines(goal, 0.5, 1.0 * (goal != self.stand.here))]
                    self.connection.sendall(("\n".join(lines) + "\n").encode())
                    time.sleep(len(lines) / RATE / self.speed)
            except OSError:
                if self.connection is not None:
                    self.connection.close()

    def drop(self):
        if self.connection is not None:
            with contextlib.suppress(OSError):
                self.connection.shutdown(socket.SHUT_RDWR)
            self.connection.close()

    def close(self):
        self.stopped = True
        self.drop()
        with contextlib.suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)  # wakes up who waits
        self.listener.close()
        self.thread.join(5)


WITHOUT_PICTURES = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import pictures
pictures.leave_out(setattr)
from mwdcal.app.cli import main
main()
"""


class BenchProcess:
    """`mwdcal bench` as a process of its own, and a client that acts on its page.

    Without pictures in the papers it takes half the time from the last station to the certificate.
    """

    def __init__(self, *arguments, folder, pictures=True):
        import httpx

        program = ("-m", "mwdcal") if pictures else ("-c", WITHOUT_PICTURES)
        command = (sys.executable, *program, "bench", "--no-browser", "--session", folder)
        self.process = subprocess.Popen(
            [*map(str, command), *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.url = self.process.stdout.readline().strip()
        if not self.url:
            raise RuntimeError(self.process.stderr.read())
        base, self.token = self.url.split("/?token=")
        self.client = httpx.Client(base_url=base, timeout=30, follow_redirects=True)
        for _ in range(100):
            try:
                self.client.get(f"/?token={self.token}")
                break
            except httpx.TransportError:
                time.sleep(0.05)

    def page(self):
        return self.client.get("/").text

    def do(self, name, **form):
        return self.client.post(f"/do/{name}", data={"token": self.token, **form})

    def order(self):
        """The position that the page asks for, and how many stations it shows."""
        page = self.page()
        match = re.search(r'name="position" value="(\d+)"', page)
        count = re.search(r"Stations: (\d+) / \d+", page)
        return (int(match[1]) if match else None), int(count[1])

    def kill(self):
        self.process.kill()
        self._end()

    def stop(self):
        self.process.send_signal(2)
        self._end()

    def _end(self):
        self.process.wait(20)
        self.process.stdout.close()
        self.process.stderr.close()
        self.client.close()


def lines_of(path: Path) -> list[str]:
    return path.read_text("utf-8").splitlines()
