"""What all command line tools share: exit codes and one-line errors."""

from __future__ import annotations

import argparse
import importlib
import sys

from .device import DeviceError, load_device


class ToolError(Exception):
    """A failure the tool can name in one line: exit code 1."""


def run(body, parser: argparse.ArgumentParser, argv=None) -> int:
    """Parse `argv` and call `body(args)`. Returns the exit code: 0, 1 for a ToolError or OSError (one line on stderr),
    130 for Ctrl-C.

    argparse itself exits with 2 for unusable arguments; `parser.error` does the same for what only `body` can find.
    """
    args = parser.parse_args(argv)
    return exit_code(lambda: body(args), parser.prog)


def exit_code(work, program: str) -> int:
    """What `work()` returns, 0 for None; 1 for a ToolError or OSError (one line on stderr), 130 for Ctrl-C."""
    try:
        return work() or 0
    except (ToolError, OSError) as error:
        print(f'{program}: {" ".join(str(error).split())}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def need(module: str, extra: str):
    """The imported `module`, or a ToolError that names the extra to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ToolError(f'needs {module.split(".")[0]}, which is not installed here ({error}): pip install '
                        f'"fluoro_shape_ros[{extra}]"') from error


# ---- types of arguments


def device(text: str) -> str:
    """The name or file of a device, as it is given, once it is known to be one."""
    try:
        load_device(text)
    except DeviceError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def positive(text: str) -> float:
    """A number above zero, and not beyond all measure."""
    if not 0 < (number := float(text)) < 1e12:
        raise argparse.ArgumentTypeError(f'{text} is not above zero, or endless')
    return number


def natural(text: str) -> int:
    """0, 1, 2, ..."""
    if (number := int(text)) < 0:
        raise argparse.ArgumentTypeError(f'{text} is below zero')
    return number


def count(text: str) -> int:
    """A number of things, at least one."""
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f'{text}: at least one is needed')
    return number
