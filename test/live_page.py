"""A page that a server feeds, in a real headless Chromium: what test_web.py stands on. It is driven by the DevTools
protocol through a pipe, in real time."""

import base64
import json
import os
import select
import subprocess
import time
from contextlib import suppress

from browser import CHROMIUM

OPTIONS = ('--headless', '--no-sandbox', '--disable-dev-shm-usage', '--no-first-run', '--use-angle=swiftshader',
           '--enable-unsafe-swiftshader', '--remote-debugging-pipe')


class LivePage:
    """A context manager: `url` in a window of `size` px; `requested` are the addresses that it asked for so far.

    Those that the page's own policy forbade it to ask for are not among them.
    """

    def __init__(self, url, folder, size=(700, 500)):
        self._requested = {}
        self._url, self._profile, self._size, self._count, self._buffer = url, folder / 'profile', size, 0, b''

    def __enter__(self):
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()

        def on_3_and_4():       # where Chromium looks for them
            a, b = os.dup(commands), os.dup(answers)
            os.dup2(a, 3)
            os.dup2(b, 4)

        self.process = subprocess.Popen([CHROMIUM, *OPTIONS, f'--window-size={self._size[0]},{self._size[1]}',
                                         f'--user-data-dir={self._profile}', 'about:blank'],
                                        pass_fds=(3, 4, commands, answers), preexec_fn=on_3_and_4,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(commands)
        os.close(answers)
        target = self.call('Target.createTarget', url='about:blank')['targetId']
        self._session = self.call('Target.attachToTarget', targetId=target, flatten=True)['sessionId']
        self.call('Network.enable')
        self.call('Page.navigate', url=self._url)
        return self

    def __exit__(self, *_):
        with suppress(OSError):
            os.close(self._commands)
        self.process.terminate()
        self.process.wait()
        os.close(self._answers)

    @property
    def requested(self):
        return set(self._requested.values())

    def call(self, method, limit=120.0, **parameters):
        """The result of a command."""
        self._count += 1
        session = {} if method.startswith('Target.') else {'sessionId': self._session}
        os.write(self._commands,
                 json.dumps(dict(id=self._count, method=method, params=parameters, **session)).encode() + b'\0')
        deadline = time.monotonic() + limit
        while True:
            message = self._next(deadline)
            if message.get('method') == 'Network.requestWillBeSent':
                self._requested[message['params']['requestId']] = message['params']['request']['url']
            elif message.get('method') == 'Network.loadingFailed' and message['params'].get('blockedReason') == 'csp':
                self._requested.pop(message['params']['requestId'], None)
            elif message.get('id') == self._count:
                return message['result']

    def _next(self, deadline):
        while b'\0' not in self._buffer:
            ready, _, _ = select.select([self._answers], [], [], max(deadline - time.monotonic(), 0.0))
            assert ready, 'Chromium does not answer'
            self._buffer += os.read(self._answers, 2**20)
        message, _, self._buffer = self._buffer.partition(b'\0')
        return json.loads(message)

    def evaluate(self, script):
        """The value of a JavaScript expression."""
        return self.call('Runtime.evaluate', expression=script, returnByValue=True)['result'].get('value')

    def until(self, script, limit=240.0):
        """Whether a JavaScript expression came true before the deadline."""
        return self.wait(lambda: self.evaluate(script), limit)

    def wait(self, condition, limit=60.0):
        """Whether `condition()` came true before the deadline."""
        deadline = time.monotonic() + limit
        while not (found := condition()) and time.monotonic() < deadline:
            select.select([], [], [], 0.2)
            self.evaluate('0')      # lets events come in
        return bool(found)

    def screenshot(self):
        """A PNG."""
        return base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])
