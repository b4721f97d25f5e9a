"""Start a command, wait until it is the node /fluoro_shape, end it with SIGINT: exit 0 when all of that happened."""

import signal
import subprocess
import sys
import time

import rclpy

process = subprocess.Popen(sys.argv[1:])
rclpy.init()
watcher = rclpy.create_node('ci_watcher')
deadline = time.monotonic() + 30
there = False
while not there and process.poll() is None and time.monotonic() < deadline:
    rclpy.spin_once(watcher, timeout_sec=0.1)
    there = ('fluoro_shape', '/') in watcher.get_node_names_and_namespaces()
rclpy.try_shutdown()
process.send_signal(signal.SIGINT)
try:
    code = process.wait(10)
except subprocess.TimeoutExpired:
    process.kill()
    code = 'still running 10 s after SIGINT'
print(f'{sys.argv[1]}: {"started" if there else "never came up"}, exit code {code}')
sys.exit(not there or code != 0)
