"""Access control for MuJoCo Studio's web server: this machine alone, and never pages of other sites.

Studio listens on every interface, gives the first visitor control of the simulation, loads uploaded models, and has no
setting for any of this. :func:`guarded` gives it another socket and checks every request. If a version of Studio takes
neither, its viewer is refused.
"""

import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import mujoco

from torchrl_mcp.viewer.studio import web_server, web_viewer

HERE = "127.0.0.1"
"""Address for access from this machine alone."""

NAMES = (HERE, "localhost")
"""Names of the viewer's address: a stranger's DNS name may resolve to this machine, too."""

FITTING = b"""<meta name="viewport" content="width=device-width, initial-scale=1">
<style>canvas { height: 100dvh }</style>
"""
"""What Studio's page lacks: without it a small screen shows the page 980 pixels wide, and hides its lower edge."""


@contextmanager
def guarded() -> Iterator[None]:
    """Let a viewer that the block opens listen on this machine alone, and check requests with :func:`refusal`.

    The viewer logs warnings alone, not every connection of a browser.

    Raises:
        RuntimeError: If this version of Studio opens its server in another way, so that nobody knows who sees it.
    """
    names = ((web_server, "bind_public_socket"), (web_server, "serve"), (web_viewer, "_print_url_banner"))
    if not all(hasattr(module, name) for module, name in names):
        raise RuntimeError(
            f"MuJoCo Studio {mujoco.__version__} opens its web server in a way that is not known to be safe: use "
            "--viewer window, or install mujoco 3.17 or 4.0"
        )
    level = web_server.logger.level
    bind = web_server.bind_public_socket
    serve = web_server.serve
    banner = web_viewer._print_url_banner
    web_server.logger.setLevel(logging.WARNING)
    web_server.bind_public_socket = lambda _, port=0: bind(HERE, port)
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
    """Return why a request is refused, or None if it is not.

    Args:
        headers: Headers ``Host`` and, if a browser sends it, ``Origin``.
    """
    host = headers.get("Host", "")
    origin = headers.get("Origin")
    if urlsplit(f"//{host}").hostname not in NAMES:
        return f"the viewer answers to {' and '.join(NAMES)} alone: call it by one of them"
    if origin is not None and urlsplit(origin).netloc != host:
        return "pages of other sites may not use the viewer"
    return None


def fitted(response: Any) -> Any:
    """Let a page fit the width and height of a screen; return other responses, and None, as they are."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    response.body = response.body.replace(b"</head>", FITTING + b"</head>", 1)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


def _checking(serve: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
    """Return a function that serves like another, and answers requests only after checking them."""

    def checking(handler: Callable[..., Awaitable[Any]], *, process_request: Callable, **settings: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            if reason := refusal(request.headers):
                return connection.respond(403, f"{reason}\n")
            return fitted(process_request(connection, request))

        return serve(handler, process_request=admit, **settings)

    return checking


def _greeting(port: int) -> str:
    return (
        f"http://localhost:{port}/, for this machine alone. Ctrl+C ends it. From another machine: "
        f"ssh -L {port}:localhost:{port} USER@THIS_MACHINE, then open the same address there"
    )
