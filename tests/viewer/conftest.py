import functools
import shutil
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from torchrl_mcp.viewer.page.runtimes import runtimes


@pytest.fixture(scope="session")
def page_runtimes():
    """Folder of the runtimes of web pages, which npm fetches once."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed: apt-get install npm")
    try:
        return runtimes()
    except ValueError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def serve():
    """Serve folders at local addresses, until the tests end: ``serve(folder)`` is the address."""
    servers = []

    class Silent(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    def start(folder):
        server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Silent, directory=str(folder)))
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
