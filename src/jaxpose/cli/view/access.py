"""Who may see the page of a run: its own browser, and those who have its address.

viser serves whoever reaches its port. Here every request is looked at before viser sees it: a WebSocket is
opened only by a page of this server (other pages in the user's browser could read the run through it), a name
that is not the server's is refused (another name may be made to lead here), and a page for other machines has
a token.
"""

import http
import inspect
import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.cookies import SimpleCookie
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from jaxpose.errors import DataError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_ANY = ("0.0.0.0", "::", "")
_LOOK_UP_S = 1.0


class Access(NamedTuple):
    """Who may see a page."""

    host: str  # that is listened at
    token: str | None  # that requests need; None: only this machine reaches it
    cookie: str  # that keeps it


def access(host: str) -> Access:
    """Who may see a page at an address.

    Args:
        host: that is listened at.

    Returns:
        With a new token unless only this machine reaches it.

    Raises:
        DataError: at once for what is no address of this machine.
    """
    found = _looked_up(host)
    try:
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            probe.bind((found[0][4][0], 0))
    except OSError as error:
        raise DataError(f"--host {host}: expected an address of this machine, got {error.strerror}") from None
    here = all(place[4][0].startswith("127.") or place[4][0] == "::1" for place in found)
    return Access(host, None if here else secrets.token_urlsafe(16), f"jaxpose-{secrets.token_hex(4)}")


def url(allowed: Access, port: int) -> str:
    """The address of a page, token and all.

    Args:
        allowed: who may see it.
        port: where it is.

    Returns:
        For the browser; of all addresses of this machine the one that leads to others.
    """
    host = allowed.host
    if host in _ANY:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # an address for documentation: nothing is sent
                host = probe.getsockname()[0]
            except OSError:
                host = socket.gethostname()
    host = "localhost" if host == "127.0.0.1" else f"[{host}]" if ":" in host else host
    return f"http://{host}:{port}" + (f"/?token={allowed.token}" if allowed.token else "")


def refusal(allowed: Access, path: str, headers: Any) -> tuple[http.HTTPStatus | None, bool]:
    """Whether a request is refused, and whether it showed the token in its address.

    Args:
        allowed: who may see the page.
        path: that is asked for.
        headers: of the request.

    Returns:
        The reason, None for none; and whether a cookie is to keep the token.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    name = urlsplit(f"//{host}").hostname or ""
    if allowed.token is None and name not in (*_LOOPBACK, allowed.host):
        return http.HTTPStatus.FORBIDDEN, False
    if origin is not None and urlsplit(origin).netloc != host:
        return http.HTTPStatus.FORBIDDEN, False
    if allowed.token is None:
        return None, False
    shown = parse_qs(urlsplit(path).query).get("token", [""])[0]
    kept = SimpleCookie(headers.get("Cookie", "")).get(allowed.cookie)
    if secrets.compare_digest(shown.encode(), allowed.token.encode()):
        return None, True
    if kept is not None and secrets.compare_digest(kept.value.encode(), allowed.token.encode()):
        return None, False
    return http.HTTPStatus.FORBIDDEN, False


@contextmanager
def guarding(allowed: Access) -> Iterator[None]:
    """While a server of viser is made in the block, its requests are put through `refusal`.

    viser has no place for that: what it calls to listen is replaced for as long.

    Args:
        allowed: who may see the page.
    """
    import websockets.asyncio.server as server
    from websockets import Headers
    from websockets.http11 import Response

    listen = server.serve

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        async def checked(connection: Any, request: Any) -> Any:
            reason, keep = refusal(allowed, request.path, request.headers)
            if reason is not None:
                return Response(reason.value, reason.phrase, Headers(), b"not for you\n")
            response = process_request(connection, request)
            response = await response if inspect.isawaitable(response) else response
            if keep and response is not None:
                kept = f"{allowed.cookie}={allowed.token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Set-Cookie"] = kept
            return response

        return listen(*args, process_request=checked, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = listen


def _looked_up(host: str) -> list[Any]:
    """The addresses of a name; DataError where that takes longer than a second."""
    found: list[Any] = []

    def look_up() -> None:
        try:
            kind = {"type": socket.SOCK_STREAM, "flags": socket.AI_PASSIVE}
            found.extend(socket.getaddrinfo(host or None, 0, **kind))
        except (OSError, UnicodeError):
            pass

    thread = threading.Thread(target=look_up, daemon=True)
    thread.start()
    thread.join(_LOOK_UP_S)
    if not found:
        raise DataError(f"--host {host}: expected an address of this machine, got an unknown name")
    return found
