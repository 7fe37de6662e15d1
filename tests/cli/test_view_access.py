"""Who may see the page of a run: requests as browsers and others send them, and the server itself."""

import asyncio
import http
import re
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

from jaxpose.cli.view import access
from jaxpose.cli.view.access import Access, refusal
from jaxpose.errors import DataError

HERE = Access("127.0.0.1", None, "c")
OPEN = Access("0.0.0.0", "secret", "c")


@pytest.mark.parametrize(
    ("allowed", "path", "headers", "refused"),
    [
        (HERE, "/", {"Host": "localhost:8080"}, False),
        (HERE, "/", {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, False),
        (HERE, "/", {"Host": "[::1]:8080"}, False),
        (HERE, "/", {"Host": "localhost:8080", "Origin": "http://evil.example"}, True),  # a page in a browser
        (HERE, "/", {"Host": "localhost:8080", "Origin": "http://localhost:9999"}, True),
        (HERE, "/", {"Host": "localhost:8080", "Origin": "null"}, True),
        (
            HERE,
            "/",
            {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
            True,
        ),  # DNS rebinding
        (HERE, "/", {}, True),
        (OPEN, "/", {"Host": "10.0.0.1:8080"}, True),
        (OPEN, "/?token=secret", {"Host": "10.0.0.1:8080"}, False),
        (OPEN, "/?token=Secret", {"Host": "10.0.0.1:8080"}, True),
        (OPEN, "/?token=%C3%A9", {"Host": "10.0.0.1:8080"}, True),
        (OPEN, "/", {"Host": "10.0.0.1:8080", "Cookie": "a=b; c=secret"}, False),
        (OPEN, "/", {"Host": "10.0.0.1:8080", "Cookie": "c=other"}, True),
        (OPEN, "/", {"Host": "10.0.0.1:8080", "Cookie": "c=secret", "Origin": "http://x.example"}, True),
    ],
)
def test_requests(allowed, path, headers, refused):
    reason, keep = refusal(allowed, path, headers)
    assert (reason is http.HTTPStatus.FORBIDDEN) == refused
    assert keep == (path == "/?token=secret")


def test_only_this_machine_needs_no_token():
    assert access.access("127.0.0.1").token is None
    first, second = (access.access("0.0.0.0").token for _ in range(2))
    assert first and second and first != second and len(first) > 20
    url = access.url(Access("0.0.0.0", "secret", "c"), 8080)
    assert re.fullmatch(r"http://[\w.-]+:8080/\?token=secret", url) and "0.0.0.0" not in url
    assert access.url(HERE, 80) == "http://localhost:80"


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.77", "a" * 300, "\udcff"])
def test_an_unknown_host_fails_at_once(host):
    began = time.monotonic()
    with pytest.raises(DataError, match="--host .*: expected an address of this machine, got"):
        access.access(host)
    assert time.monotonic() - began < 5  # the thread that asks is given a second


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_the_server_lets_in_its_own_page_only(host):
    view_page = pytest.importorskip("jaxpose.cli.view.page")
    from websockets.asyncio.client import connect
    from websockets.exceptions import InvalidStatus

    allowed = access.access(host)
    with access.guarding(allowed):
        server = view_page._server(host, 0)
    try:
        port = server.get_port()
        root, token = f"http://127.0.0.1:{port}/", f"?token={allowed.token}" if allowed.token else ""
        with urllib.request.urlopen(root + token) as page:
            cookie, content = page.headers.get("Set-Cookie", ""), page.read()
        assert b"<html" in content and bool(cookie) == bool(token)
        if token:
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(root)

        async def opened(origin, kept):
            headers = {"Cookie": kept.split(";")[0]} if kept else {}
            protocol = f"viser-v{__import__('viser').__version__}"
            async with connect(root.replace("http", "ws"), origin=origin, additional_headers=headers,
                               subprotocols=[protocol]):  # fmt: skip
                return True

        assert asyncio.run(opened(f"http://127.0.0.1:{port}", cookie))
        for origin, kept in (
            ("http://evil.example", cookie),
            *([(f"http://127.0.0.1:{port}", "")] if token else []),
        ):
            with pytest.raises(InvalidStatus, match="403"):
                asyncio.run(opened(origin, kept))
    finally:
        view_page._stop(server)


def test_text_is_shown_letter_by_letter():
    view_page = pytest.importorskip("jaxpose.cli.view.page")
    shown = view_page.paragraphs("<img src=x onerror=alert(1)> & [a](javascript:b)", "two\x1b")
    assert shown == "<p>&lt;img src=x onerror=alert(1)&gt; &amp; [a](javascript:b)</p><p>two\\x1b</p>"


def test_a_value_that_fails_is_shown_and_the_next_is_worked_on():
    view_page = pytest.importorskip("jaxpose.cli.view.page")
    shown = []

    def work(value):
        if value == 1:
            raise np.linalg.LinAlgError("singular")

    ask, stop = view_page.latest(work, lambda error: shown.append(error and str(error)))
    for value in (1.0, 2.0):
        ask(value)
        while len(shown) < value:
            time.sleep(0.01)
    stop()
    assert shown == ["singular", None]
