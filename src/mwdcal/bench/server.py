"""The bench as a web server on this machine: one session, several browsers that watch it.

Who has the token in the address may decide. A GET changes nothing, nor does another site's form, or a request under
another host's name. No request leaves the machine.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import secrets
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from functools import partial
from importlib.resources import files
from ipaddress import ip_address
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

from mwdcal.bench import pages, spreadsheet_page
from mwdcal.bench.session import BenchSession
from mwdcal.bench.sources import LineSource
from mwdcal.bench.spreadsheet import DroppedTable
from mwdcal.bench.stream import LARGEST_VALUE, TEMPERATURE_COLUMN
from mwdcal.errors import InputError, MwdcalError
from mwdcal.files.contract import RAW

TICK = 0.1
"""Seconds between live figures."""
LEAST_ACCURACY = 0.001
"""Smallest 1σ of the azimuth, degrees, for which a plan is sought."""
LARGEST_FORM = 64_000
"""Bytes of a form that are read."""
LARGEST_TABLE = 20_000_000
"""Bytes of a table that are read."""
TOKEN_HEADER = "x-bench-token"
"""Carries the token where the body is a file; another site's script may not send it."""
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
UNCHANGING = ("GET", "HEAD")
"""Methods that change nothing."""
STATIC = {"bench.js": "text/javascript", "table.js": "text/javascript", "bench.css": "text/css"}


class Bench:
    """A session, its source, and the server's doors. `hosts` are the names, with port, under which it answers.

    `any_address`: it answers under any address of the machine, too, which no other site can have.
    """

    def __init__(
        self, session: BenchSession, source: LineSource, hosts: Collection[str], token: str | None = None,
        any_address: bool = False,
    ) -> None:  # fmt: skip
        self.session, self.source, self.hosts, self.any_address = (
            session,
            source,
            hosts,
            any_address,
        )
        self.token = token or secrets.token_urlsafe(24)
        self.cookie = f"mwdcal_bench_{next(iter(hosts)).rpartition(':')[2]}"
        self.stop = Event()
        self.reader = Thread(target=self._read, name="bench source", daemon=True)
        self._fragment: tuple[tuple[int, bool] | None, str] = (None, "")
        self._changed = asyncio.Event()
        entered = None if session.countersign else session.registry  # not before the signature
        self.table = table = DroppedTable(session.folder / "table", entered, session.laboratory)
        self._tables: dict[str, Callable[[Mapping[str, str], bytes], None]] = {
            "file": lambda form, data: table.drop(form.get("name", ""), data),
            "rolltest": lambda form, data: table.drop_rolltest(form.get("name", ""), data),
            "answer": lambda form, data: self._answer(form),
            "serial": lambda form, data: table.state_serial(form.get("serial", "")[:100]),
            "back": lambda form, data: table.take_back(),
            "calibrate": lambda form, data: table.calibrate(),
            "certificate": lambda form, data: table.certify(form.get("number", "").strip()[:100]),
        }
        self._forms: dict[str, Callable[[Mapping[str, str]], None]] = {
            "start": self._start,
            "accept": lambda form: session.accept(_whole(form.get("position", ""))),
            "again": lambda form: session.measure_again(_whole(form.get("position", ""))),
            "choose": lambda form: session.choose(form.get("serial", "")[:100]),
            "sign": lambda form: session.sign(form.get("passphrase", "")[:1000]),
            "auto": lambda form: session.switch("auto", "on" in form),
            "certificate": lambda form: session.certify(form.get("number", "").strip()[:100]),
            "typed": self._typed,
            "temperature": self._temperature,
        }
        self._buttons: dict[str, Callable[[], None]] = {
            "resume": session.resume,
            "undo": session.undo,
            "skip": session.skip,
            "pause": lambda: session.switch("paused", True),
            "go_on": lambda: session.switch("paused", False),
            "calibrate": session.calibrate,
            "rolltest": session.start_rolltest,
            "reopen": session.reopen,
            "repeat": session.repeat_rolltest,
            "enter": session.enter,
        }

    def decide(self, name: str, form: Mapping[str, str]) -> bool:
        """Do what a form or a button asks for; whether there is one of this name."""
        if name in self._forms:
            self._forms[name](form)
        elif name in self._buttons:
            self._buttons[name]()
        return name in self._forms or name in self._buttons

    # ------------------------------------------------------------------ the source

    def _read(self) -> None:
        while not self.stop.is_set():
            try:
                for time, line in self.source.lines(self.stop):
                    self.session.line(time, line)
            except Exception as error:  # the session must go on
                self.session.say(
                    f"the source has failed ({type(error).__name__}: {error}). Trying again."
                )
            self.stop.wait(1.0)

    def _start(self, form: Mapping[str, str]) -> None:
        earth = {
            name: _number(form.get(name, ""), pages.texts()[name])
            for name in pages.STAND_REFERENCES
        }
        serial, operator, plan, tool, file = (
            form.get(name, "")[:100]
            for name in ("serial", "operator", "plan", "tool", "own_plan_name")
        )
        if plan == pages.FEWEST_PLAN:
            plan = self._fewest(form)
        plan_file = file, form.get("own_plan", "")
        stand = self._stand(form)
        self.session.start(
            serial,
            operator,
            plan,
            earth,
            tool=tool,
            tool_text=form.get("own_tool", ""),
            plan_file=plan_file,
            stand=stand,
        )

    def _stand(self, form: Mapping[str, str]) -> dict[str, float]:
        """The 1σ of the stand that differ from those that the form has shown."""
        changed = {}
        for name, shown in pages.stand_fields(self.session):
            value = _number(form.get(name, ""), pages.texts()[name])
            if value is None or f"{value:g}" == shown:
                continue
            if not 0 < value < 90:
                raise InputError(f"{pages.texts()[name]}: give one above 0 and below 90.")
            changed[name.removeprefix("stand_")] = value
        return changed

    def _fewest(self, form: Mapping[str, str]) -> str:
        """The plan of the fewest stations for an accuracy, by its name."""
        wanted = _number(form.get("accuracy", ""), pages.texts()["accuracy_wanted"])
        if wanted is None or not LEAST_ACCURACY <= wanted <= 10:
            raise InputError(
                f"{pages.texts()['accuracy_wanted']}: give one from {LEAST_ACCURACY} to 10."
            )
        return f"azimuth_deg={wanted:g}"

    def _typed(self, form: Mapping[str, str]) -> None:
        """Readings by hand are stations, one a line."""
        lines = [line for line in form.get("reading", "").splitlines() if line.strip()]
        rows = [typed_reading(line, self.session.stream.channels) for line in lines]
        if not rows:
            raise InputError("there is no reading. Type one, or paste one a line.")
        self.session.accept_typed(rows, _whole(form.get("position", "")))

    def _temperature(self, form: Mapping[str, str]) -> None:
        value = _number(form.get("temperature", ""), pages.texts()["temperature"])
        if value is None:
            raise InputError("the temperature is missing. Type it in °C.")
        self.session.state_temperature(value)

    def _answer(self, form: Mapping[str, str]) -> None:
        question, place = (_whole(form.get(name, "")) for name in ("question", "place"))
        numbers = {
            name: _number(form.get(name, ""), name)
            for name in ("declination_deg", "convergence_deg")
        }
        if question is None or place is None:
            raise InputError("the answer is missing. Open the page again.")
        self.table.answer(question, place, numbers)

    # ------------------------------------------------------------------ requests

    def answers_to(self, host: str) -> bool:
        """Whether a host with port is the bench's. Another site can give its name our address, no more."""
        return host in self.hosts or (self.any_address and _is_address(host))

    @property
    def shown(self) -> tuple[int, bool]:
        """Version of the session, and whether there is a table: the page is of both."""
        return self.session.version, bool(self.table.name)

    def fragment(self) -> str:
        """The changing part of the page, made once for all browsers."""
        shown = self.shown
        if self._fragment[0] != shown:
            self._fragment = shown, pages.fragment(self.session, self.token, shown[1])
        return self._fragment[1]

    async def page(self, request: Request) -> Response:
        """The page."""
        if "token" in request.query_params:
            answer: Response = RedirectResponse("/", 303)
            answer.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
            return answer
        return HTMLResponse(
            await run_in_threadpool(pages.page, self.session, self.token, bool(self.table.name))
        )

    async def static(self, request: Request) -> Response:
        """Script and style."""
        name = request.path_params["name"]
        if name not in STATIC:
            return PlainTextResponse("there is no such file", 404)
        data = files("mwdcal.bench").joinpath("static", name).read_bytes()
        return Response(data, media_type=STATIC[name])

    async def paper(self, request: Request) -> Response:
        """A document of the session, or of the table."""
        name = request.path_params["name"]
        of = self.table if request.url.path.startswith("/table/") else self.session
        if name not in of.papers.values() or not (of.folder / name).is_file():
            return PlainTextResponse("there is no such document", 404)
        answer = FileResponse(of.folder / name)
        answer.headers["Content-Security-Policy"] = PAPER_POLICY
        return answer

    async def table_page(self, request: Request) -> Response:
        """The page of a table that was dropped."""
        return HTMLResponse(await run_in_threadpool(spreadsheet_page.page, self.table, self.token))

    async def act_on_table(self, request: Request) -> Response:
        """A decision on the table that was dropped, or the table itself."""
        name, state = request.path_params["name"], request.state
        if name not in self._tables:
            return PlainTextResponse("there is nothing of this name", 404)
        try:
            await run_in_threadpool(self._tables[name], state.form, state.data)
        except MwdcalError as error:
            return PlainTextResponse(str(error), 409)
        return PlainTextResponse("done")

    async def act(self, request: Request) -> Response:
        """A decision."""
        name, form = request.path_params["name"], request.state.form
        try:
            if not await run_in_threadpool(self.decide, name, form):
                return PlainTextResponse("there is nothing of this name", 404)
        except MwdcalError as error:
            return PlainTextResponse(str(error), 409)
        if "text/html" in request.headers.get("accept", ""):
            return RedirectResponse("/", 303)
        return PlainTextResponse("done")

    async def events(self, request: Request) -> Response:
        """Live figures, and the page whenever it has changed."""
        return StreamingResponse(self._events(request), media_type="text/event-stream")

    async def _events(self, request: Request) -> AsyncIterator[str]:
        seen: tuple[int, bool] | None = None
        last = ""
        while not self.stop.is_set():
            changed = self._changed
            if self.shown != seen:
                seen = self.shown
                yield _event("page", await run_in_threadpool(self.fragment))
            now = pages.live(self.session, self.source)
            if (text := json.dumps(now)) != last:
                last = text
                yield f"event: live\ndata: {text}\n\n"
            if await request.is_disconnected():
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), TICK)

    def _wake(self) -> None:
        """Wake the event streams: the page is another one."""
        self._changed.set()
        self._changed = asyncio.Event()

    def app(self) -> Starlette:
        """The server."""

        @contextlib.asynccontextmanager
        async def life(app: Starlette) -> AsyncIterator[None]:
            loop = asyncio.get_running_loop()
            self.session.on_change = partial(loop.call_soon_threadsafe, self._wake)
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
            Route("/table", self.table_page),
            Route("/table/files/{name}", self.paper),
            Route("/table/{name}", self.act_on_table, methods=["POST"]),
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
            await self._form(request) if request.method not in UNCHANGING else None
        )
        await (door or self.app)(scope, receive, with_headers)

    def _refusal(self, request: Request) -> Response | None:
        """Why a request is not from the bench's page, if it is not."""
        if not self.bench.answers_to(request.headers.get("host", "")):
            return PlainTextResponse("this address is not the bench's", 421)
        known = request.query_params.get("token") or request.cookies.get(self.bench.cookie) or ""
        if not self._is_token(known):
            return PlainTextResponse(
                "Open the address that mwdcal bench has printed: it has the token.", 403
            )
        if request.method in UNCHANGING:
            return None
        origin, site = request.headers.get("origin"), request.headers.get("sec-fetch-site", "")
        foreign = origin is not None and not self.bench.answers_to(_netloc(origin))
        if foreign or site in ("cross-site", "same-site"):
            return PlainTextResponse("this form is not the bench's", 403)
        return None

    async def _form(self, request: Request) -> Response | None:
        """Read the form, or the file; refuse one that is too long, or does not come with the token."""
        by_header = request.headers.get(TOKEN_HEADER, "")
        is_file = self._is_token(by_header)
        data = bytearray()
        async for chunk in request.stream():
            data += chunk
            if len(data) > (LARGEST_TABLE if is_file else LARGEST_FORM):
                return PlainTextResponse("this is too long", 413)
        if is_file:
            request.state.form, request.state.data = dict(request.query_params), bytes(data)
            return None
        try:
            form = parse_qs(data.decode(), keep_blank_values=True, max_num_fields=50)
        except ValueError:
            return PlainTextResponse("this is no form", 400)
        request.state.form = {name: values[-1] for name, values in form.items()}
        request.state.data = b""
        if not self._is_token(request.state.form.pop("token", "")):
            return PlainTextResponse("this form is not the bench's", 403)
        return None

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "replace"), self.bench.token.encode())


def _netloc(origin: str) -> str:
    """Host and port of an origin; blank if it is not one."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _event(name: str, content: str) -> str:
    return f"event: {name}\ndata: {json.dumps(content)}\n\n"


def _is_address(host: str) -> bool:
    """Whether a host with port is an address rather than a name."""
    try:
        ip_address(host.rpartition(":")[0].strip("[]"))
        return True
    except ValueError:
        return False


def typed_reading(line: str, channels: Sequence[str]) -> dict[str, float]:
    """A reading by channel; numbers stand apart by blanks, tabs, semicolons or commas, or have a decimal comma.

    Raises:
        InputError: a word is not a number, or the numbers are not those of the channels.
    """
    between = (
        r"[\s;]+" if "," in line and "." not in line and re.search(r"\d,\d", line) else r"[\s;,]+"
    )
    words = [word.replace(",", ".") for word in re.split(between, line.strip())]
    if between != r"[\s;,]+" and len(words) < 3:  # 1,2,3: whole numbers
        words = line.replace(",", " ").split()
    values = [_number(word, "reading") for word in words if word]
    if len(values) in (len(channels), len(channels) - 1) and channels:
        names: Sequence[str] = channels
    else:
        names = {3: RAW[:3], 6: RAW, 7: (*RAW, TEMPERATURE_COLUMN)}.get(len(values), ())
    if not names:
        raise InputError(
            f"a reading is {' '.join(RAW)} and, if known, the temperature; got {len(values)} numbers. Type it again."
        )
    return {name: v for name, v in zip(names, values, strict=False) if v is not None}


def _number(text: str, name: str) -> float | None:
    """A number of the form; None if it is blank."""
    if not text.strip():
        return None
    try:
        value = float(text)
        if abs(value) < LARGEST_VALUE:
            return value
    except ValueError:
        pass
    raise InputError(f"{name}: '{text[:40]}' is not a number, or too large. Correct it.")


def _whole(text: str) -> int | None:
    """A position of the form, from 0; None if it is blank."""
    if not text:
        return None
    if re.fullmatch("[0-9]{1,6}", text):
        return int(text)
    raise InputError(f"position: '{text[:40]}' is not a whole number. Open the page again.")
