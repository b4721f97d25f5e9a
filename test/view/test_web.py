"""The page: who may read it, that it speaks to nobody else, and how far it draws in a real browser."""

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.request import urlopen

import pytest

pytest.importorskip('rerun')
import recording
from browser import CHROMIUM
from drawing import BASE, GOOD
from live_page import LivePage

from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.view.page import LOOPBACK, POLICY, address, known, serve
from fluoro_shape_ros.view.viewer import free_port

READ = '/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages'


class Rerun(BaseHTTPRequestHandler):
    """As Rerun's program: a page, and data that never end."""

    def do_GET(self):
        self.send_response(200)
        self.send_header('content-type', 'text/html')
        self.send_header('set-cookie', 'a=b')
        self.end_headers()
        self.wfile.write(b'<html>the page</html>')

    def do_POST(self):
        asked = self.rfile.read(int(self.headers['content-length']))
        self.send_response(200)
        self.send_header('content-type', 'application/grpc-web+proto')
        self.send_header('access-control-allow-origin', '*')
        self.end_headers()
        self.wfile.write(b'first of ' + asked)
        self.wfile.flush()
        self.server.go_on.wait(30)

    def log_message(self, *_):
        pass


@pytest.fixture(scope='module')
def served():
    """The port of a page whose Rerun is the one above."""
    port = free_port()
    with ThreadingHTTPServer((LOOPBACK, 0), Rerun) as server:
        server.go_on, server.daemon_threads, server.block_on_close = threading.Event(), True, False
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with serve(LOOPBACK, port, *[server.server_address[1]] * 2):
            yield port
        server.go_on.set()
        server.shutdown()


def ask(port, method, path, host=None, body=None):
    """Status, headers and the first bytes of an answer."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=20)
    connection.request(method, path, body, {'Host': host or f'localhost:{port}', 'Origin': 'https://elsewhere.example'})
    answer = connection.getresponse()
    start = answer.read1(100)
    connection.close()
    return answer.status, answer.headers, start


def test_the_page_is_told_to_speak_to_nobody_but_here(served):
    status, headers, start = ask(served, 'GET', '/?url=any')
    assert ((status, start) == (200, b'<html>the page</html>') and headers['content-security-policy'] == POLICY
            and headers['set-cookie'] is None)
    assert "default-src 'self'" in POLICY and 'connect-src' not in POLICY and 'http' not in POLICY


def test_the_bare_address_leads_to_the_data_by_the_name_that_was_asked_for(served):
    status, headers, _ = ask(served, 'GET', '/', host=f'127.0.0.1:{served}')
    assert status == 302 and headers['location'].startswith(f'/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{served}%2Fproxy')


def test_data_come_while_they_are_made_and_to_no_other_page(served):
    status, headers, start = ask(served, 'POST', READ, body=b'all')
    assert (status, start) == (200, b'first of all') and headers['access-control-allow-origin'] is None


@pytest.mark.parametrize('method, path, host', [('POST', READ.replace('Read', 'Write'), None),
                                                ('POST', READ, 'elsewhere.example'), ('GET', '/', 'elsewhere.example'),
                                                ('GET', '/?url=any', '')])
def test_what_is_not_for_looking_is_refused(served, method, path, host):
    assert ask(served, method, path, ' ' if host == '' else host, b'x' if method == 'POST' else None)[0] == 403


@pytest.mark.parametrize('host, known_here', [('127.0.0.1:9090', True), ('localhost', True), ('192.0.2.1:80', True),
                                              ('[::1]:9090', True), (f'{socket.gethostname()}:9090', True),
                                              ('localhost.example:9090', False), ('127.0.0.1.example', False),
                                              ('', False)])
def test_names_that_others_can_give_this_machine_are_unknown(host, known_here):
    assert known(host) == known_here


def test_a_port_that_is_taken_is_named():
    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ToolError, match=f'port {port} of 127.0.0.1'), serve(LOOPBACK, port, 1, 1):
            pass


# ---- with Rerun


@pytest.fixture(scope='module')
def page(tmp_path_factory):
    """The port of a process that shows the results of one pair until the tests are over; it must end with 0 then."""
    folder, port = tmp_path_factory.mktemp('bag'), free_port()
    recording.record(folder / 'run', [GOOD])
    assert recording.main(folder / 'run', '--out', folder / 'results', '--with-images', '-p', BASE) == 0
    child = subprocess.Popen([sys.executable, '-m', 'fluoro_shape_ros.view.main', '--bag', str(folder / 'results'),
                              '--web', '--port', str(port)],
                             stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = child.stdout.readline()
        assert (line.strip() == 'fluoro_shape_view: to be seen at '
                                f'{address(LOOPBACK, port)}'), child.communicate(timeout=60)
        yield port, child
        child.send_signal(signal.SIGINT)
        _, told = child.communicate(timeout=60)
        assert (child.returncode, told) == (0, '')
    finally:
        if child.poll() is None:
            child.kill()
            child.communicate(timeout=60)


def listening(pid):
    """The local addresses, as /proc writes them, at which a process or a child of it listens."""
    pids, inodes = [pid], set()
    for number in pids:
        pids += [int(child) for task in os.listdir(f'/proc/{number}/task')
                 for child in open(f'/proc/{number}/task/{task}/children').read().split()]
        inodes |= {os.readlink(f'/proc/{number}/fd/{fd}') for fd in os.listdir(f'/proc/{number}/fd')
                   if os.path.islink(f'/proc/{number}/fd/{fd}')}
    tables = [line.split() for name in ('tcp', 'tcp6') for line in open(f'/proc/net/{name}').read().splitlines()[1:]]
    return {row[1].split(':')[0] for row in tables if row[3] == '0A' and f'socket:[{row[9]}]' in inodes}


@pytest.mark.skipif(not os.path.exists('/proc/net/tcp'), reason='no /proc')
def test_everything_listens_on_this_machine_alone(page):
    _, child = page
    assert listening(child.pid) == {'0100007F'}


def test_rerun_page_comes_with_our_policy(page):
    port, _ = page
    with urlopen(f'http://{LOOPBACK}:{port}/', timeout=60) as answer:
        assert 'proxy' in answer.url and answer.headers['content-security-policy'] == POLICY
        assert b'Rerun Viewer' in answer.read()


@pytest.mark.skipif(CHROMIUM is None, reason='needs Chromium')
def test_a_browser_draws_it_and_asks_nobody_else(page, tmp_path):
    port, _ = page
    with LivePage(f'http://{LOOPBACK}:{port}/', tmp_path) as browser:
        # Rerun shows its canvas once it can draw
        assert browser.until("document.getElementById('the_canvas_id')?.classList.contains('visible')"), (
            browser.evaluate('document.body.innerText'))
        assert browser.wait(lambda: any(url.endswith(READ) for url in browser.requested))
        assert 'crashed' not in browser.evaluate('document.body.innerText')
    assert {url for url in browser.requested if not re.match(f'http://{LOOPBACK}:{port}/|blob:|data:', url)} == set()
