"""Many bags through the replay: each in a process of its own, so that none can stop another, and one table over all of
them at the end."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from tqdm import tqdm

from ..cli import ToolError, exit_code

FILES = ('report', 'csv', 'npz', 'json')    # options that name a file, of which each bag gets one of its own
HEAD = ('bag', 'pairs', 'answered', 'refused', 'most often', 'or failed')


def replay_all(args: argparse.Namespace) -> int:
    """Replay `args.bags` into the folder `args.out`, `args.jobs` at a time; the exit code, 130 where it was
    interrupted. Raises ToolError where a bag failed."""
    names, out = names_of(args.bags), Path(args.out)
    out.mkdir(exist_ok=True)
    if args.scheduler:
        found, interrupted = _on_cluster(args, names)
    else:
        found, interrupted = _in_processes(args, names)
    print(table(names, found))
    failed = [name for name, (_, failure) in zip(names, found) if failure]
    if failed and not interrupted:
        raise ToolError(f'{len(failed)} of {len(names)} bags failed: {", ".join(failed)}')
    return 130 if interrupted else 0


def _in_processes(args: argparse.Namespace, names: list[str]) -> tuple[list[tuple[dict, str]], bool]:
    """What each bag came to, see _replay, by processes of this machine; whether it was interrupted."""
    found: list[tuple[dict, str]] = [({}, 'not begun')] * len(names)
    interrupted = False
    running: set[subprocess.Popen] = set()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.jobs) as pool:
        tasks = {pool.submit(_replay, args, bag, name, Path(folder) / f'{k}.json', running): k
                 for k, (bag, name) in enumerate(zip(args.bags, names))}
        try:
            for task in tqdm(as_completed(tasks), 'replaying', len(tasks), unit='bag', disable=None):
                found[tasks[task]] = task.result()
        except KeyboardInterrupt:       # those at work keep what they have
            interrupted = True
            for task in tasks:
                task.cancel()
            for process in tuple(running):
                process.send_signal(signal.SIGINT)
            pool.shutdown()
            for task, k in tasks.items():
                if not task.cancelled():
                    found[k] = task.result()
    return found, interrupted


def _on_cluster(args: argparse.Namespace, names: list[str]) -> tuple[list[tuple[dict, str]], bool]:
    """The same by the workers of a Dask scheduler, which see the same folders. Raises ToolError where that does not
    work, see bench.jobs."""
    from ..jobs import in_order

    found: list[tuple[dict, str]] = [({}, 'not begun')] * len(names)
    there = argparse.Namespace(**vars(args) | dict(out=str(Path(args.out).resolve()),
                                                   params=args.params and str(Path(args.params).resolve())))
    results = in_order(_replay_there, [(there, str(Path(bag).resolve()), name) for bag, name in zip(args.bags, names)],
                       scheduler=args.scheduler)
    try:
        for k, result in enumerate(tqdm(results, 'replaying', len(names), unit='bag', disable=None)):
            found[k] = result
    except KeyboardInterrupt:
        return found, True
    return found, False


def _replay_there(task: tuple[argparse.Namespace, str, str]) -> tuple[dict, str]:
    """One bag on a worker."""
    with tempfile.TemporaryDirectory() as folder:
        return _replay(*task, Path(folder) / 'summary.json', set())


def names_of(bags: list[str]) -> list[str]:
    """A name for the results of each bag: its own, with as many of the folders around it as it takes to tell all apart.
    Raises ToolError for one given twice."""
    paths = [Path(bag).resolve() for bag in bags]
    for path in paths:
        if paths.count(path) > 1:
            raise ToolError(f'{path.name} was given twice')
    own = [path.stem if path.is_file() else path.name for path in paths]
    for depth in range(1, max(len(path.parts) for path in paths)):
        names = ['_'.join((*path.parts[-depth:-1], name)) for path, name in zip(paths, own)]
        if len(set(names)) == len(names):
            break
    return names


def _replay(args: argparse.Namespace, bag: str, name: str, summary: Path, running: set) -> tuple[dict, str]:
    """What the replay of a bag came to (see `replay.as_json`), and why it failed or ''."""
    own = {file: str(Path(args.out) / f'{name}_{Path(getattr(args, file)).name}')
           for file in FILES if getattr(args, file)}
    given = vars(args) | own | dict(bags=[bag], out=str(Path(args.out) / name), json=str(summary))
    # Ctrl-C at the terminal must reach it once, through us
    with subprocess.Popen([sys.executable, '-m', __name__, json.dumps(given)], stdin=subprocess.DEVNULL,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                          start_new_session=True) as process:
        running.add(process)
        _, errors = process.communicate()
        running.discard(process)
    counted = json.loads(summary.read_text()) if summary.exists() else {}
    if args.json and counted:
        Path(own['json']).write_text(json.dumps(counted))
    if process.returncode in (130, -signal.SIGINT):
        return counted, 'interrupted'
    said = (errors.strip().splitlines() or [''])[-1].partition(': ')[2]
    return counted, '' if process.returncode == 0 else said or f'ended with {process.returncode}'


def table(names: list[str], found: list[tuple[dict, str]]) -> str:
    """A line a bag and one for all, columns side by side."""
    rows, total = [HEAD], [0, 0]
    for name, (counted, failure) in zip(names, found):
        outcomes = counted.get('outcomes', {})
        pairs, answered = sum(outcomes.values()), outcomes.get('ok', 0)
        total = [total[0] + pairs, total[1] + answered]
        often = max((o for o in outcomes if o != 'ok'), key=outcomes.get, default='')
        rows.append((name, str(pairs), str(answered), str(pairs - answered), often, failure))
    rows.append(('all', str(total[0]), str(total[1]), str(total[0] - total[1]), '',
                 f'{sum(bool(failure) for _, failure in found)} of {len(names)} failed'))
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEAD))]
    return '\n'.join('  '.join(cell.rjust(width) if 0 < k < 4 else cell.ljust(width)
                               for k, (cell, width) in enumerate(zip(row, widths))).rstrip() for row in rows)


def main() -> int:
    """The replay of one bag, with the arguments of the replay as they were parsed, in JSON."""
    from .replay import make_parser, replay

    parser = make_parser()
    return exit_code(lambda: replay(argparse.Namespace(**json.loads(sys.argv[1])), parser), parser.prog)


if __name__ == '__main__':
    sys.exit(main())
