"""fluoro_shape_bench: how accurate, how robust and how fast the reconstruction is, on seeded scenes with known
truth."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
from pathlib import Path

from tqdm import tqdm

from ..cli import ToolError, count, natural, need, positive, run
from ..config import fields
from ..jobs import in_order
from ..method.judge import judge_of
from . import calibration_watch, judge, latency, memory, prediction, speed, streams, variety
from .case import Family
from .composites import load
from .families import ACCURACY, ROBUSTNESS, Sources, families, on_real
from .latency import moving_scenes
from .score import (
    CHI2_95,
    PICTURES,
    SILENT_MEAN,
    SILENT_TIP,
    WITHIN_MEAN,
    WITHIN_TIP,
    Answer,
    Task,
    Trial,
    attempt,
    attempt_or_skip,
)
from .table import plain, rows, table

DEVICE = 9              # default seed of what moves in front of the node
METHODS = next(f for f in fields() if f.name == 'method').metadata['choices']


def main(argv=None) -> int:
    """The command line. A command adds itself to the parser and says which function of (args, parser) is its body."""
    parser = argparse.ArgumentParser('fluoro_shape_bench', description='Tables of accuracy, robustness and speed on '
                                                                       'seeded scenes with known truth.')
    commands = parser.add_subparsers(dest='command', required=True)
    _add_tables(commands, 'accuracy', 'nothing but the device in the images, beside the Cramer-Rao bound', ACCURACY)
    robustness = _add_tables(commands, 'robustness',
                             'one difficulty at a time, and scenes where nothing may be published', ROBUSTNESS)
    robustness.add_argument('--real', type=Path, metavar='DIR',
                            help='real backgrounds for the families real, real_mask and real_blank: '
                            'background_plane_{a,b}.png and calibration.json '
                                 '(K or K_corrected, R, t of plane_a and plane_b)')
    _add_variety(commands)
    streams.add(commands)
    calibration_watch.add(commands)
    _add_judge(commands)
    _add_speed(commands)
    _add_latency(commands)
    _add_memory(commands)
    _add_prior(commands)
    return run(lambda args: args.body(args, parser), parser, argv)


def _add_speed(commands) -> None:
    text = ('how long a pair takes, checked against truth, in ms and in multiples of a yardstick that is '
            'timed in between')
    command = commands.add_parser('speed', help=text, description=f'{text[0].upper()}{text[1:]}.')
    command.add_argument('--sizes', type=count, nargs='+', default=[512, 768, 1024, 1536, 2048], metavar='PX',
                         help='image sizes; all show the same field at the same dose (default: 512 768 1024 1536 2048)')
    command.add_argument('--scenes', type=count, default=20, metavar='N',
                         help='anatomy scenes of each size (default: 20)')
    command.add_argument('--rounds', type=count, default=5, metavar='N',
                         help='how often each is timed, all others in between (default: 5)')
    command.add_argument('--first-seed', type=natural, default=0, metavar='SEED',
                         help='seeds count up from here (default: 0)')
    command.add_argument('--alone', action='store_true',
                         help='without method paper and skimage\'s frangi, which take seconds a pair')
    command.add_argument('--json', type=Path, metavar='FILE', help='write every time there, in s')
    command.set_defaults(body=_speed)


def _add_prior(commands) -> None:
    command = commands.add_parser('prior', help='what a predicted_backbone is worth on the first pair, good or wrong')
    command.add_argument('--families', nargs='+', metavar='NAME', choices=list(families()),
                         default=list(prediction.FAMILIES),
                       help='see accuracy and robustness; and faint, '
                            f'a fortieth of the dose (default: {" ".join(prediction.FAMILIES)})')
    command.add_argument('--scenes', type=count, default=10, metavar='N', help='scenes of each family (default: 10)')
    command.add_argument('--rounds', type=count, default=3, metavar='N', help='how often each is timed (default: 3)')
    command.add_argument('--first-seed', type=natural, default=0, metavar='SEED',
                         help='seeds count up from here (default: 0)')
    command.set_defaults(body=_prior)


def _prior(args, parser: argparse.ArgumentParser) -> int:
    """Print the table of predictions."""
    print(prediction.report(args.families, args.scenes, args.first_seed, args.rounds))
    return 0


def _speed(args, parser: argparse.ArgumentParser) -> int:
    """Print the table of times."""
    _check_files(args.json)
    beside = 1024 if 1024 in args.sizes else args.sizes[0]
    found = [laps for size in sorted(set(args.sizes))
             for laps in speed.measure(size, args.scenes, args.rounds, args.first_seed,
                                       speed.COMPARED if size == beside and not args.alone else 0)]
    if not any(laps.right for laps in found):
        raise ToolError(f'none of {args.scenes} scenes a size was answered rightly, so no time means anything')
    print(speed.table(found))
    if args.json:
        args.json.write_text(json.dumps({'command': args.command, 'first_seed': args.first_seed,
                                         'laps': speed.plain(found)}, indent=1) + '\n')
    return 0


def _add_latency(commands) -> None:
    text = 'how late an answer is on real topics, beside CPU, memory, start-up and what is lost, at several rates'
    command = commands.add_parser('latency', help=text,
                                  description=f'{text[0].upper()}{text[1:]}: the node runs as a process of its own.')
    command.add_argument('--rates', type=positive, nargs='+', default=[7.5, 15, 30, 60, 200], metavar='HZ',
                         help='pairs a second (default: 7.5 15 30 60 200)')
    command.add_argument('--seconds', type=positive, default=60.0, metavar='S', help='at each rate (default: 60)')
    command.add_argument('--as-shipped', action='store_true',
                         help='Fast DDS as it comes, without this package\'s profile for megapixel images')
    command.add_argument('--full', action='store_true',
                         help='parameter tracking off: every pair is searched from scratch')
    _add_node_options(command)
    command.set_defaults(body=_latency)


def _add_memory(commands) -> None:
    text = 'whether the node\'s memory grows'
    command = commands.add_parser('memory', help=text, description=f'{text[0].upper()}{text[1:]}: it runs as a process '
                                                                   'of its own, on real topics.')
    command.add_argument('--pairs', type=count, default=10_000, metavar='N', help='(default: 10000)')
    command.add_argument('--everything', action='store_true', help='subscribe to overlays, markers and points too')
    _add_node_options(command)
    command.set_defaults(body=_memory)


def _add_node_options(command: argparse.ArgumentParser) -> None:
    command.add_argument('--size', type=count, default=1024, metavar='PX', help='of the images (default: 1024)')
    command.add_argument('--rendered', type=count, default=32, metavar='N',
                         help='pairs that are rendered beforehand and played forth and back (default: 32)')
    command.add_argument('--seed', type=natural, default=DEVICE, help='another seed is another device and anatomy')
    command.add_argument('--domain', type=int, choices=range(233), default=48, metavar='ID',
                         help='ROS_DOMAIN_ID, so that nothing else on this machine is disturbed')
    command.add_argument('--json', type=Path, metavar='FILE', help='write what was measured there, in s and bytes')


def _ready_for_ros(args) -> None:
    """Raises ToolError without ROS; after this it may be used."""
    _check_files(args.json)
    need('rclpy', 'ros')
    os.environ.update(ROS_DOMAIN_ID=str(args.domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    latency.choose_profile(getattr(args, 'as_shipped', False))


def _latency(args, parser: argparse.ArgumentParser) -> int:
    """Print a line a rate."""
    _ready_for_ros(args)
    rows = [latency.measure(rate, args.seconds, moving_scenes(args.size, rate, args.seed, args.rendered), not args.full)
            for rate in args.rates]
    print(latency.table(rows, args.as_shipped))
    if args.json:
        args.json.write_text(json.dumps({'command': args.command, 'as_shipped': args.as_shipped,
                                         'rows': [latency.plain(r) for r in rows]}, indent=1) + '\n')
    return 0


def _memory(args, parser: argparse.ArgumentParser) -> int:
    """Print how much it was and how it grew."""
    _ready_for_ros(args)
    measured = memory.measure(args.pairs, moving_scenes(args.size, memory.RATE, args.seed, args.rendered),
                              args.everything)
    print(memory.report(measured, args.size))
    if args.json:
        args.json.write_text(json.dumps({'command': args.command, **dataclasses.asdict(measured),
                                         'growth': measured.growth}, indent=1) + '\n')
    return 0


def _check_files(*files: Path | None) -> None:
    """Raises ToolError for one that could not be written when the work is done."""
    for file in filter(None, files):
        if not file.absolute().parent.is_dir():
            raise ToolError(f'{file}: there is no such folder')


def _add_scene_command(commands, name: str, text: str, families: dict[str, str],
                       methods: tuple[str, ...]) -> argparse.ArgumentParser:
    """A command that tries scenes of `families`, whose texts are given by name."""
    width = max(12, *map(len, families))
    epilog = 'families:\n' + '\n'.join(f'  {n:{width}s} {family}' for n, family in families.items())
    command = commands.add_parser(name, help=text, description=f'{text[0].upper()}{text[1:]}.', epilog=epilog,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument('--families', nargs='+', metavar='NAME', help='(default: all)')
    command.add_argument('--methods', nargs='+', metavar='METHOD', choices=METHODS, default=list(methods),
                         help=f'of {", ".join(METHODS)} '
                              f'(default: {"all" if methods == METHODS else " ".join(methods)})')
    command.add_argument('--scenes', type=count, default=20, metavar='N', help='scenes of each family (default: 20)')
    command.add_argument('--first-seed', type=int, default=0, metavar='SEED',
                         help='seeds count up from here (default: 0)')
    return command


def _add_jobs(command) -> None:
    command.add_argument('--jobs', type=count, default=2, metavar='N',
                         help='processes of one thread each; the table does not depend on it (default: 2)')


def _add_tables(commands, name: str, text: str, families: dict[str, Family]) -> argparse.ArgumentParser:
    """A command that prints the table of `families`."""
    command = _add_scene_command(commands, name, text, {n: f.text for n, f in families.items()}, METHODS)
    _add_jobs(command)
    command.add_argument('--json', type=Path, metavar='FILE',
                         help='write the rows and every scene\'s answers there, in m')
    command.add_argument('--plot', type=Path, metavar='FILE.png', help='draw errors and shares')
    command.set_defaults(body=_tables, group=families, real=None)
    return command


def _tables(args, parser: argparse.ArgumentParser) -> int:
    """Try all scenes, print the table, write the files."""
    if args.real:
        load(args.real)     # says at once what is wrong with it
    known = args.group | (on_real(args.real) if args.real else {})
    names = args.families or list(known)
    if unknown := [n for n in names if n not in known]:
        hint = ' (and more with --real)' if unknown[0].startswith('real') else ''
        parser.error(f'no such family: {", ".join(unknown)}; there are {", ".join(known)}{hint}')
    if args.plot and args.plot.suffix.lower() != '.png':
        parser.error(f'--plot {args.plot}: only .png can be drawn')
    _check_files(args.json, args.plot)
    _check_first_seed(args, parser)
    if 'p' in names:
        need('vtkmodules.vtkRenderingOpenGL2', 'vtk')
    if args.plot:
        need('matplotlib', 'plot')
    methods = tuple(dict.fromkeys(args.methods))
    tasks = [Task(name, args.first_seed + k, methods, args.real) for name in dict.fromkeys(names)
             for k in range(args.scenes)]
    trials = list(tqdm(in_order(attempt, tasks, args.jobs), total=len(tasks), unit='scene', disable=None))
    found = rows(trials)
    print(table(found))
    if args.json:
        args.json.write_text(json.dumps({'command': args.command, 'first_seed': args.first_seed, 'limits': LIMITS,
                                         'rows': plain(found), 'trials': [_plain(t) for t in trials]}, indent=1) + '\n')
    if args.plot:
        from .plot import draw  # imports matplotlib
        draw(trials, args.plot)
    return 0


def _check_first_seed(args, parser: argparse.ArgumentParser) -> None:
    if args.first_seed < 0:
        parser.error(f'--first-seed {args.first_seed}: seeds count from 0')


def _add_variety(commands) -> None:
    text = ('a world as wide as the clinic: by family of scenes and kind of device, '
            'with CPU time and why pairs are refused')
    command = _add_scene_command(commands, 'variety', text, variety.texts(), ('spline',))
    workers = command.add_mutually_exclusive_group()
    _add_jobs(workers)
    workers.add_argument('--scheduler', metavar='ADDRESS',
                         help='instead: HOST:PORT of a Dask scheduler, whose workers (dask worker --nthreads 1) '
                         'need this package and the files below')
    command.add_argument('--ct', type=Path, metavar='FILE', help='for ct and ct_none: a folder with one DICOM series, '
                                                                 'or NPZ with hu (z, y, x) and spacing_m')
    command.add_argument('--open', type=Path, metavar='DIR',
                         help='for open: a folder of scenes, each with plane_a.png, plane_b.png and scene.json; '
                         'these are taken by name from the first, whatever --first-seed')
    command.add_argument('--no-base', action='store_true', help='keep the base\'s position back')
    command.add_argument('--min-confidence', type=float, metavar='P',
                         help='instead of the default of the parameter; 0: the best curve of every pair is published')
    command.add_argument('--plot', type=Path, metavar='FILE.png',
                         help='how often confidence is right, and what is answered and wrong over min_confidence; '
                         'best with --min-confidence 0')
    command.add_argument('--radius-error', type=_radius_error, default=0.0, metavar='R',
                         help='give 1 + R times the true radius (default: 0)')
    command.add_argument('--json', type=Path, metavar='FILE',
                         help='write the rows and every scene\'s answers there, in m and s')
    command.add_argument('--pictures', type=natural, default=0, metavar='N',
                         help='contact sheets of the first N pairs of each family (default: 0)')
    command.add_argument('--pictures-of', choices=PICTURES, default='all',
                         help='of those that the first method answered, refused or got wrong (default: all)')
    command.add_argument('--sheets', type=Path, default=Path('sheets'), metavar='DIR',
                         help='where they go (default: sheets)')
    command.set_defaults(body=_variety)


def _radius_error(text: str) -> float:
    if not -0.9 <= (share := float(text)) <= 9:
        raise argparse.ArgumentTypeError(f'{text} does not lie in -0.9 to 9')
    return share


def _sources(args, parser: argparse.ArgumentParser) -> Sources:
    """What the families are made from, by absolute paths, since a worker may run anywhere; ends where one that is asked
    for does not exist or lacks its source."""
    given, texts = {'--ct': args.ct, '--open': args.open}, variety.texts()
    for name in args.families or ():
        if name not in texts:
            parser.error(f'no such family: {name}; there are {", ".join(texts)}')
        if (option := variety.needed(name)) and not given[option.split()[0]]:
            parser.error(f'{name} needs {option}')
    return Sources(**{option[2:]: path and path.absolute() for option, path in given.items()})


def _variety(args, parser: argparse.ArgumentParser) -> int:
    """Try all scenes, print the table, write the files and sheets."""
    sources = _sources(args, parser)
    _check_first_seed(args, parser)
    if args.min_confidence is not None and not 0 <= args.min_confidence <= 1:
        parser.error(f'--min-confidence {args.min_confidence:g} does not lie in 0 to 1')
    if args.plot and args.plot.suffix.lower() != '.png':
        parser.error(f'--plot {args.plot}: only .png can be drawn')
    known = variety.known(sources)
    names = list(dict.fromkeys(args.families or known))
    _check_files(args.json, args.plot)
    if args.plot:
        need('matplotlib', 'plot')
    if args.pictures:
        args.sheets.mkdir(parents=True, exist_ok=True)
    if 'gvxr' in names:
        need('gvxrPython3', 'gvxr')
    if args.scheduler:
        need('distributed', 'cluster')
    methods = tuple(dict.fromkeys(args.methods))
    tasks = [Task(name, seed, methods, sources=sources, base=not args.no_base, radius_error=args.radius_error,
                  min_confidence=args.min_confidence,
                  picture=args.pictures_of if args.pictures and (k < args.pictures or args.pictures_of != 'all')
                          else '')
             for name in names for k, seed in enumerate(variety.seeds(known[name], args.first_seed, args.scenes))]
    done = tqdm(in_order(attempt_or_skip, tasks, args.jobs, args.scheduler), total=len(tasks), unit='scene',
                disable=None)
    trials = list(variety.fewer_pictures((t for t in done if t is not None), args.pictures))
    if not trials:
        raise ToolError('no scene could be drawn')
    print(variety.table(trials))
    if args.json:
        given = {'command': args.command, 'first_seed': args.first_seed, 'base': not args.no_base,
                 'radius_error': args.radius_error}
        args.json.write_text(json.dumps({**given, 'limits': variety.LIMITS, 'rows': variety.plain(trials),
                                         'trials': [variety.plain_trial(t) for t in trials]}, indent=1) + '\n')
    if args.plot:
        from .plot_confidence import draw  # imports matplotlib
        draw([a for trial in trials for a in trial.answers.values()], args.plot)
    if args.pictures:
        variety.write_sheets(trials, args.sheets)
    return 0


def _add_judge(commands) -> None:
    text = ('the model of confidence, made anew: resource/judge.json from every curve that a search tries in '
            'seeded scenes')
    epilog = 'scenes of each family, times N:\n' + '\n'.join(f'  {name:14s} {share:g}'
                                                             for name, share in judge.FAMILIES.items())
    command = commands.add_parser('judge', help=text, description=f'{text[0].upper()}{text[1:]}.', epilog=epilog,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument('--scenes', type=count, default=20, metavar='N', help='(default: 20)')
    command.add_argument('--first-seed', type=natural, default=judge.FIRST_SEED, metavar='SEED',
                         help=f'seeds count up from here (default: {judge.FIRST_SEED}); '
                         'report on others')
    command.add_argument('--ct', type=Path, metavar='FILE',
                         help='for ct: a folder with one DICOM series, or NPZ with hu (z, y, x) and spacing_m')
    command.add_argument('--out', type=Path, default=Path('judge.json'), metavar='FILE', help='(default: judge.json)')
    workers = command.add_mutually_exclusive_group()
    _add_jobs(workers)
    workers.add_argument('--scheduler', metavar='ADDRESS', help='instead: HOST:PORT of a Dask scheduler')
    command.set_defaults(body=_judge, families=None, open=None)


def _judge(args, parser: argparse.ArgumentParser) -> int:
    """Try everything in all scenes, learn, write the file."""
    sources = _sources(args, parser)
    variety.known(sources)
    _check_files(args.out)
    if args.scheduler:
        need('distributed', 'cluster')
    tasks = judge.tasks(args.scenes, args.first_seed, sources)
    done = tqdm(in_order(judge.gather, tasks, args.jobs, args.scheduler), total=len(tasks), unit='scene', disable=None)
    scenes = [s for s in done if s is not None]
    try:
        content = judge.learn(scenes)
    except ValueError as error:
        raise ToolError(str(error)) from error
    said = (f'fluoro_shape_bench judge --scenes {args.scenes} --first-seed '
            f'{args.first_seed}{" --ct FILE" if args.ct else ""}')
    args.out.write_text(json.dumps({'made_by': said, **content}, indent=1) + '\n')
    print(judge.table(judge_of(content), scenes))
    return 0


LIMITS = {'within_mean_m': WITHIN_MEAN, 'within_tip_m': WITHIN_TIP, 'silent_mean_m': SILENT_MEAN,
          'silent_tip_m': SILENT_TIP, 'honest_chi2': CHI2_95}


def _plain(trial: Trial) -> dict:
    """A trial for JSON."""
    return {'family': trial.task.family, 'seed': trial.task.seed, 'note': next(iter(trial.answers.values())).note,
            'bound_m': dataclasses.asdict(trial.bound) if trial.bound else None,
            'answers': {method: _plain_answer(a) for method, a in trial.answers.items()}}


def _plain_answer(a: Answer) -> dict:
    return {'outcome': a.outcome.value, 'detail': a.detail,
            'errors_m': dataclasses.asdict(a.errors) if a.errors else None,
            'surprise': None if math.isnan(a.surprise) else min(a.surprise, 1e12), 'within': a.within,
            'silent_failure': a.silent_failure}


if __name__ == '__main__':
    raise SystemExit(main())
