"""Restricts MuJoCo Studio's web server to this machine, and refuses requests from pages of other sites.

By default Studio listens on every interface, gives the first visitor control of the simulation and loads uploaded
models, and no setting changes this. :func:`guarded` replaces its socket and checks every request. A version of Studio
in which this is impossible is refused.
"""

import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import mujoco

from torchrl_mcp.viewer.studio import web_server, web_viewer

LOOPBACK = "127.0.0.1"
"""Address that only this machine can reach."""

NAMES = (LOOPBACK, "localhost")
"""Permitted names of the viewer. The DNS name of an attacker may resolve to this machine, too."""

FITTING = b"""<meta name="viewport" content="width=device-width, initial-scale=1">
<style>canvas { height: 100dvh }</style>
"""
"""Lines that Studio's page lacks: otherwise a small screen shows the page 980 pixels wide and hides its lower edge."""


@contextmanager
def guarded() -> Iterator[None]:
    """Let the viewer that the block opens listen on this machine only, and check its requests with :func:`refusal`.

    The viewer logs only warnings, not every connection of a browser.

    Raises:
        RuntimeError: If this version of Studio opens its server in another way, so that access cannot be restricted.
    """
    names = ((web_server, "bind_public_socket"), (web_server, "serve"), (web_viewer, "_print_url_banner"))
    if not all(hasattr(module, name) for module, name in names):
        raise RuntimeError(
            f"MuJoCo Studio {mujoco.__version__} opens its web server in a way to which access cannot be restricted: "
            "use --viewer window, or install mujoco 3.17 or 4.0"
        )
    level = web_server.logger.level
    bind = web_server.bind_public_socket
    serve = web_server.serve
    banner = web_viewer._print_url_banner
    web_server.logger.setLevel(logging.WARNING)
    web_server.bind_public_socket = lambda _, port=0: bind(LOOPBACK, port)
    web_server.serve = _checking(serve)
    web_viewer._print_url_banner = lambda _, port: print(_greeting(port), flush=True)
    try:
        yield
    finally:
        web_server.logger.setLevel(level)
        web_server.bind_public_socket = bind
        web_server.serve = serve
        web_viewer._print_url_banner = banner


def refusal(headers: Mapping[str, str]) -> str | None:
    """Return the reason why a request is refused, or None if the request is permitted.

    Args:
        headers: Headers of the request, of which ``Host`` and ``Origin`` are read.
    """
    host = headers.get("Host", "")
    origin = headers.get("Origin")
    if urlsplit(f"//{host}").hostname not in NAMES:
        return f"the viewer must be opened as {' or '.join(NAMES)}"
    if origin is not None and urlsplit(origin).netloc != host:
        return "pages of other sites must not use the viewer"
    return None


def fitted(response: Any) -> Any:
    """Add :data:`FITTING` to a page, so that it fits the screen; return other responses, and None, unchanged."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    response.body = response.body.replace(b"</head>", FITTING + b"</head>", 1)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


def _checking(serve: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
    """Return a function that serves like ``serve``, but checks every request first."""

    def checking(handler: Callable[..., Awaitable[Any]], *, process_request: Callable, **settings: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            if reason := refusal(request.headers):
                return connection.respond(403, f"{reason}\n")
            return fitted(process_request(connection, request))

        return serve(handler, process_request=admit, **settings)

    return checking


def _greeting(port: int) -> str:
    return (
        f"Open http://localhost:{port}/ on this machine; Ctrl+C ends the viewer. From another machine, run "
        f"ssh -L {port}:localhost:{port} USER@THIS_MACHINE there and open the same address"
    )
