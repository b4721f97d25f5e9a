"""Rerun's page and its data at one address, and nothing else: what comes from here is told to speak to nobody but here.

By itself the page reports to its makers how it is used and asks other servers for fonts and releases, and older
releases of Rerun hand their data to whatever page in the same browser asks for it.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

from ..cli import ToolError

LOOPBACK = '127.0.0.1'
PORT = 9090         # unless told otherwise
# WebAssembly, started by a script in the page
POLICY = ("default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
          "frame-ancestors 'none'; form-action 'none'; base-uri 'none'")
READING = 'Read'    # begins the names of the calls by which data are read; those that change anything are not passed on
PASSED = 'content-type', 'accept', 'x-grpc-web', 'x-user-agent', 'grpc-timeout'      # headers of such a call
ANSWERED = 'content-type', 'content-encoding', 'rerun-final-length', 'grpc-status', 'grpc-message'


def address(bind: str, port: int) -> str:
    """Of the page, as it is entered in a browser."""
    return f'http://{socket.gethostname() if bind == "0.0.0.0" else bind}:{port}/'


@contextlib.contextmanager
def serve(bind: str, port: int, page_port: int, data_port: int) -> Iterator[None]:
    """Serve at `bind` and `port` what Rerun's program serves on this machine at `page_port` and `data_port`. Raises
    ToolError where that can't be."""
    class Handler(_Handler):
        page, data = page_port, data_port

    try:
        server = ThreadingHTTPServer((bind, port), Handler)
    except OSError as error:
        raise ToolError(f'port {port} of {bind} can\'t be used ({error.strerror or error}); '
                        'see --bind and --port') from error
    server.daemon_threads, server.block_on_close = True, False      # data are read without end
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    page: int
    data: int

    def do_GET(self) -> None:
        host = self.headers.get('Host', '')
        parts = urlsplit(self.path)
        if not known(host):
            self.send_error(403, 'Not a name of this machine')
        elif parts.path == '/' and 'url=' not in parts.query:
            self.send_response(302)
            self.send_header('Location', f'/?url={quote(f"rerun+http://{host}/proxy", safe="")}&theme=dark')
            self.end_headers()
        else:
            self._pass_on(self.page, None)

    def do_POST(self) -> None:
        if not known(self.headers.get('Host', '')) or not self.path.rpartition('/')[2].startswith(READING):
            self.send_error(403, 'Only reading')
        else:
            self._pass_on(self.data, self.rfile.read(int(self.headers.get('Content-Length', 0))))

    def _pass_on(self, port: int, body: bytes | None) -> None:
        connection = http.client.HTTPConnection(LOOPBACK, port)
        # whoever closes the page, or ends the program, ends it
        with contextlib.closing(connection), contextlib.suppress(OSError, http.client.HTTPException):
            connection.request(self.command, self.path, body,
                               {name: self.headers[name] for name in PASSED if name in self.headers})
            answer = connection.getresponse()
            self.send_response(answer.status)
            for name in ANSWERED:
                if answer.headers.get(name) is not None:
                    self.send_header(name, answer.headers[name])
            self.send_header('Content-Security-Policy', POLICY)
            self.send_header('Cache-Control', 'no-store')
            self.end_headers()
            while part := answer.read1(2**16):
                self.wfile.write(part)

    def log_message(self, *_) -> None:
        """Nothing: whoever looks is no news."""


def known(host: str) -> bool:
    """Whether a Host header names this machine. A name that somebody else can give it (DNS rebinding) would open the
    data to a page of his."""
    name = urlsplit(f'//{host}').hostname or ''
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name in ('localhost', socket.gethostname().lower(), socket.getfqdn().lower())
