"""The bench as a web server on this machine: one session, several browsers that watch it.

Who has the token in the address may decide; nothing is changed by a GET, by another site's form, or under another host's name.
No request leaves the machine.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections.abc import AsyncIterator, Callable, Mapping
from importlib.resources import files
from math import isfinite
from threading import Event, Thread
from urllib.parse import parse_qs, urlsplit

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)  # fmt: skip
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mwdcal.bench import pages
from mwdcal.bench.session import Session
from mwdcal.bench.sources import Source
from mwdcal.bench.stream import TEMPERATURE, Stream
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.contract import RAW

COOKIE = "mwdcal_bench"
TICK = 0.1
"""Seconds between live figures."""
LARGEST = 64_000
"""Bytes of a form that are read."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
PAPER_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
"""That of reports, which bring their style and script along."""
HEADERS = {
    "Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store", "Cross-Origin-Opener-Policy": "same-origin",
}  # fmt: skip
READING = ("GET", "HEAD")
"""Methods that change nothing."""
STATIC = {"bench.js": "text/javascript", "bench.css": "text/css"}


class Bench:
    """A session, its source, and the server's doors."""

    def __init__(
        self, session: Session, source: Source, hosts: tuple[str, ...], token: str | None = None
    ) -> None:
        self.session, self.source, self.hosts = session, source, hosts
        self.token = token or secrets.token_urlsafe(24)
        self.stop = Event()
        self.reader = Thread(target=self._read, name="bench source", daemon=True)
        self._fragment: tuple[int, str] = (-1, "")
        self.doors: dict[str, Callable[[Mapping[str, str]], None]] = {
            "start": self._start,
            "resume": lambda form: session.resume(),
            "accept": lambda form: session.accept(),
            "again": lambda form: session.measure_again(),
            "undo": lambda form: session.undo(),
            "skip": lambda form: session.skip(),
            "pause": lambda form: session.switch("paused", True),
            "go_on": lambda form: session.switch("paused", False),
            "auto": lambda form: session.switch("auto", "on" in form),
            "calibrate": lambda form: session.calibrate(),
            "rolltest": lambda form: session.start_rolltest(),
            "certificate": lambda form: session.certify(form.get("number", "").strip()[:100]),
            "typed": self._typed,
        }

    # ------------------------------------------------------------------ the source

    def _read(self) -> None:
        for time, line in self.source.lines(self.stop):
            self.session.line(time, line)

    def _start(self, form: Mapping[str, str]) -> None:
        earth = {name: _number(form.get(name, ""), name) for name in pages.EARTH}
        self.session.start(form.get("serial", "")[:100], form.get("operator", "")[:100], **earth)

    def _typed(self, form: Mapping[str, str]) -> None:
        """A reading by hand is a station."""
        stream = Stream(self.session.stream.form)
        line = form.get("reading", "").replace(",", " ").replace(";", " ").replace("\t", " ")
        values = _numbers(line)
        names = stream.channels or {6: RAW, 7: (*RAW, TEMPERATURE), 3: RAW[:3]}.get(len(values), ())
        if len(names) != len(values) or not values:
            raise InputError(
                f"a reading is {len(names) or 6} numbers, {' '.join(names or RAW)}; got {len(values)}. Type it again."
            )
        self.session.accept(dict(zip(names, values, strict=True)))

    # ------------------------------------------------------------------ requests

    def fragment(self) -> str:
        """The changing part of the page, made once for all browsers."""
        version = self.session.version
        if self._fragment[0] != version:
            self._fragment = (version, pages.fragment(self.session, self.token))
        return self._fragment[1]

    async def page(self, request: Request) -> Response:
        """The page."""
        if "token" in request.query_params:
            answer: Response = RedirectResponse("/", 303)
            answer.set_cookie(COOKIE, self.token, httponly=True, samesite="strict")
            return answer
        return HTMLResponse(await run_in_threadpool(pages.page, self.session, self.token))

    async def static(self, request: Request) -> Response:
        """Script and style."""
        name = request.path_params["name"]
        if name not in STATIC:
            return PlainTextResponse("there is no such file", 404)
        data = files("mwdcal.bench").joinpath("static", name).read_bytes()
        return Response(data, media_type=STATIC[name])

    async def paper(self, request: Request) -> Response:
        """A document of the session."""
        name = request.path_params["name"]
        if name not in self.session.papers.values() or not (self.session.folder / name).is_file():
            return PlainTextResponse("there is no such document", 404)
        answer = FileResponse(self.session.folder / name)
        answer.headers["Content-Security-Policy"] = PAPER_POLICY
        return answer

    async def act(self, request: Request) -> Response:
        """A decision."""
        door = self.doors.get(request.path_params["name"])
        if door is None:
            return PlainTextResponse("there is nothing of this name", 404)
        form = request.state.form
        try:
            await run_in_threadpool(door, form)
        except MwdcalError as error:
            return PlainTextResponse(str(error), 409)
        if "text/html" in request.headers.get("accept", ""):
            return RedirectResponse("/", 303)
        return PlainTextResponse("done")

    async def events(self, request: Request) -> Response:
        """Live figures, and the page whenever it has changed."""
        return StreamingResponse(self._events(request), media_type="text/event-stream")

    async def _events(self, request: Request) -> AsyncIterator[str]:
        seen, last = -1, ""
        while not self.stop.is_set():
            if self.session.version != seen:
                seen = self.session.version
                yield _event("page", await run_in_threadpool(self.fragment))
            now = pages.live(self.session, self.source.note, self.source.drops)
            if (text := json.dumps(now)) != last:
                last = text
                yield f"event: live\ndata: {text}\n\n"
            if await request.is_disconnected():
                return
            await asyncio.sleep(TICK)

    def app(self) -> Starlette:
        """The server."""

        @contextlib.asynccontextmanager
        async def life(app: Starlette) -> AsyncIterator[None]:
            self.reader.start()
            yield
            self.stop.set()
            await run_in_threadpool(self.reader.join, 5)
            await run_in_threadpool(self.session.close)

        routes = [
            Route("/", self.page),
            Route("/events", self.events),
            Route("/static/{name}", self.static),
            Route("/files/{name}", self.paper),
            Route("/do/{name}", self.act, methods=["POST"]),
        ]
        return Starlette(routes=routes, middleware=[Middleware(_Guard, bench=self)], lifespan=life)


class _Guard:
    """Lets in who knows the token, under the names of this machine, and no form of another site."""

    def __init__(self, app: ASGIApp, bench: Bench) -> None:
        self.app, self.bench = app, bench

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or say why not."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    given.setdefault(name, value)
            await send(message)

        request = Request(scope, receive)
        door = self._refusal(request) or (
            await self._form(request) if request.method not in READING else None
        )
        await (door or self.app)(scope, receive, with_headers)

    def _refusal(self, request: Request) -> Response | None:
        """Why a request is not from the bench's page, if it is not."""
        if request.headers.get("host", "") not in self.bench.hosts:
            return PlainTextResponse("this address is not the bench's", 421)
        known = request.query_params.get("token") or request.cookies.get(COOKIE) or ""
        if not self._is_token(known):
            return PlainTextResponse(
                "Open the address that mwdcal bench has printed: it has the token.", 403
            )
        if request.method in READING:
            return None
        origin, site = request.headers.get("origin"), request.headers.get("sec-fetch-site", "")
        foreign = origin is not None and _netloc(origin) not in self.bench.hosts
        if foreign or site in ("cross-site", "same-site"):
            return PlainTextResponse("this form is not the bench's", 403)
        return None

    async def _form(self, request: Request) -> Response | None:
        """Read the form; refuse one that is too long, or does not carry the token."""
        data = bytearray()
        async for chunk in request.stream():
            data += chunk
            if len(data) > LARGEST:
                return PlainTextResponse("this form is too long", 413)
        try:
            form = parse_qs(data.decode(), keep_blank_values=True, max_num_fields=50)
        except ValueError:
            return PlainTextResponse("this is no form", 400)
        request.state.form = {name: values[-1] for name, values in form.items()}
        if not self._is_token(request.state.form.pop("token", "")):
            return PlainTextResponse("this form is not the bench's", 403)
        return None

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "replace"), self.bench.token.encode())


def _netloc(origin: str) -> str:
    """Host and port of an origin; blank where it is none."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _event(name: str, content: str) -> str:
    return f"event: {name}\ndata: {json.dumps(content)}\n\n"


def _numbers(line: str) -> list[float]:
    """The numbers of a typed line."""
    try:
        values = [float(word) for word in line.split()]
        if not all(map(isfinite, values)):
            raise ValueError("infinite")
        return values
    except ValueError as error:
        raise InputError(
            f"the reading has a word that is no number ({error}). Type it again."
        ) from None


def _number(text: str, name: str) -> float | None:
    """A number of the form; None where it is blank."""
    if not text.strip():
        return None
    try:
        value = float(text)
        if isfinite(value):
            return value
        raise ValueError
    except ValueError:
        raise InputError(
            f"{pages.texts()[name]}: '{text[:40]}' is no number. Correct it."
        ) from None
