"""Access control for MuJoCo Studio's web server: by default this machine alone, and never pages of other sites.

Studio listens on every interface, lets the first visitor control the simulation, loads uploaded models, and has no
setting for any of this. This module sets the address to listen on and checks every request, by replacing functions of
Studio: :func:`guarded` is the one place that does, and refuses versions in which nobody has seen it work.
"""

import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from ipaddress import IPv6Address, ip_address
from typing import Any
from urllib.parse import urlsplit

import mujoco
from mujoco.experimental.studio import web_viewer
from mujoco.experimental.studio.web import web_server

VERIFIED = "3.17"
"""MuJoCo's version with which ``tests/viewer/test_web.py`` passes, which asks a guarded page from outside."""

HERE = "127.0.0.1"
"""Address for access from this machine alone."""

MOST_VISITORS = 6
"""Number of visitors at once, of Studio's eight spectators, so that this machine always finds a place."""

CONTROL = ("/ui", "/drop")
"""Paths on which the server accepts input, and files to load."""

FITTING = b"""<meta name="viewport" content="width=device-width, initial-scale=1">
<style>canvas { height: 100dvh }</style>
"""
"""What Studio's page lacks: without it a phone draws it 980 pixels wide, and its lower edge below its own bars."""

VISITORS = (
    "Everybody who can reach the port sees the simulation, its model and the viewer's log with paths of files. "
    "Control and uploads stay with this machine"
)


@contextmanager
def guarded(host: str) -> Iterator[None]:
    """Let viewers that the block opens listen on ``host`` alone, and check requests with :func:`refusal`.

    The viewer logs warnings alone, not every connection of a browser.

    Raises:
        RuntimeError: If this is another version of MuJoCo, in which Studio may call other functions.
        ValueError: If ``host`` is no address of this machine.
    """
    if not mujoco.__version__.startswith(f"{VERIFIED}."):
        raise RuntimeError(
            f"who may see a page of MuJoCo {mujoco.__version__} is not known: install mujoco {VERIFIED}, or use "
            "--viewer window"
        )
    address = _address(host)
    level = web_server.logger.level
    web_server.logger.setLevel(logging.WARNING)
    bind, serve, banner = web_server.bind_public_socket, web_server.serve, web_viewer._print_url_banner
    web_server.bind_public_socket = lambda _, port=0: bind(address, port)
    web_server.serve = partial(_serve, serve)
    web_viewer._print_url_banner = lambda _, port: print(_greeting(address, port), flush=True)
    try:
        yield
    finally:
        web_server.logger.setLevel(level)
        web_server.bind_public_socket, web_server.serve, web_viewer._print_url_banner = bind, serve, banner


def refusal(path: str, headers: Mapping[str, str], address: str) -> str | None:
    """Return why a request is refused, or None if it is not.

    Args:
        path: Requested path.
        headers: Headers ``Host`` and, if a browser sends it, ``Origin``.
        address: Address of the sender.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if not _is_ours(urlsplit(f"//{host}").hostname or ""):  # a stranger's DNS name may resolve to this machine
        return "this address is not the viewer's: use an IP address, or localhost"
    if origin is not None and urlsplit(origin).netloc != host:
        return "pages of other sites may not use the viewer"
    if urlsplit(path).path in CONTROL and not _is_here(address):
        return "only the viewer's own machine may control it or load models: use ssh -L"
    return None


def fitted(response: Any) -> Any:
    """Let a page fit the width and height of a screen; return other responses, and None, as they are."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    response.body = response.body.replace(b"</head>", FITTING + b"</head>", 1)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


def _serve(
    serve: Callable[..., Awaitable[Any]],
    handler: Callable[..., Awaitable[Any]],
    *,
    process_request: Callable,
    **settings: Any,
) -> Any:
    visitors: set[Any] = set()

    def admit(connection: Any, request: Any) -> Any:
        reason = refusal(request.path, request.headers, _sender(connection))
        return connection.respond(403, f"{reason}\n") if reason else fitted(process_request(connection, request))

    async def attend(connection: Any) -> None:
        if _is_here(_sender(connection)):
            await handler(connection)
        elif len(visitors) >= MOST_VISITORS:
            await connection.close(1013, "too many visitors")
        else:
            visitors.add(connection)
            try:
                await handler(_Visitor(connection))
            finally:
                visitors.remove(connection)

    return serve(attend, process_request=admit, **settings)


class _Visitor:
    """A connection whose messages but signs of life are dropped, such as those that ask for control."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        async for message in self._connection:
            if message in (web_server._STATE_ACK_MESSAGE, web_server._SessionMessage.HEARTBEAT):
                yield message


def _sender(connection: Any) -> str:
    """Address of who opened a connection, which is :data:`HERE` for this machine by any of its addresses."""
    sender: str = connection.remote_address[0]
    return HERE if sender == connection.local_address[0] else sender


def _address(host: str) -> str:
    """The numerical address of a host.

    Raises:
        ValueError: If it is no address of this machine.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as test:
            test.bind(address)
    except OSError as error:
        raise ValueError(f"host={host} is no address of this machine: pass one, or 0.0.0.0 for all") from error
    return str(address[0])


def _is_ours(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return name.lower() in {"localhost", socket.gethostname().lower(), socket.getfqdn().lower()}
    return True


def _is_here(address: str) -> bool:
    found = ip_address(address.partition("%")[0])
    mapped = found.ipv4_mapped if isinstance(found, IPv6Address) else None
    return (mapped or found).is_loopback


def _greeting(host: str, port: int) -> str:
    if _is_here(host):
        return f"http://localhost:{port}/, for this machine alone. Ctrl+C ends it"
    name = f"[{host}]" if ":" in host else host
    if host in ("0.0.0.0", "::"):
        name = f"localhost:{port}/, elsewhere http://{socket.gethostname()}"
    return f"http://{name}:{port}/. {VISITORS}. Ctrl+C ends it"
