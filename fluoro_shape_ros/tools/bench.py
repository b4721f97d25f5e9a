"""fluoro_shape_bench: how accurate, how robust, how fast; on seeded scenes with known truth."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np

from ..config import Config
from ..data import Outcome
from ..metrics import Errors, compare
from ..pipeline import reconstruct
from .cli import ToolError, need, run

SILENT_MEAN, SILENT_TIP = 1e-3, 2e-3    # m: a published result farther off than this is a silent failure


@dataclasses.dataclass(frozen=True)
class Answer:
    """One scene: what the method said and, where it gave a curve, how far off."""

    seed: int
    outcome: Outcome
    errors: Errors | None

    @property
    def silent_failure(self) -> bool:
        """Published, yet wrong."""
        return self.errors is not None and (self.errors.mean > SILENT_MEAN or self.errors.tip > SILENT_TIP)


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser('fluoro_shape_bench', description='Tables of accuracy on seeded scenes with known truth.')
    commands = parser.add_subparsers(dest='command', required=True)
    accuracy = commands.add_parser('accuracy', help='errors in mm against truth, a row a family and method')
    accuracy.add_argument('--families', nargs='+', default=['p'], metavar='NAME', help='families of scenes; "list" names them all (default: p)')
    accuracy.add_argument('--methods', nargs='+', default=['paper'], metavar='METHOD', help='values of the parameter `method` (default: paper)')
    accuracy.add_argument('--scenes', type=int, default=20, help='scenes of each family (default: 20)')
    accuracy.add_argument('--first-seed', type=int, default=0, help='seeds count up from here (default: 0)')
    accuracy.add_argument('--json', type=Path, metavar='FILE', help='write every scene\'s errors (m) there')
    return run(_accuracy, parser, argv)


def _accuracy(args) -> int:
    from .families import FAMILIES
    if args.families == ['list']:
        print('\n'.join(f'{name:12s} {text}' for name, (text, _) in FAMILIES.items()))
        return 0
    if unknown := [f for f in args.families if f not in FAMILIES]:
        raise ToolError(f'no such family: {", ".join(unknown)}; there are {", ".join(FAMILIES)}')
    if args.scenes < 1:
        raise ToolError(f'--scenes {args.scenes}: at least one is needed')
    configs = {method: Config.from_values(method=method) for method in args.methods}
    answers = {(family, method): [] for family in args.families for method in configs}
    tqdm = need('tqdm', 'bench')
    todo = [(family, args.first_seed + k) for family in args.families for k in range(args.scenes)]
    for family, seed in tqdm.tqdm(todo, unit='scene', disable=None):
        scene = FAMILIES[family][1](seed)
        for method, config in configs.items():
            answers[family, method].append(answer(scene, config))
    print(table(answers))
    if args.json:
        args.json.write_text(json.dumps({f'{f}/{m}': [_plain(a) for a in rows] for (f, m), rows in answers.items()}, indent=1))
    return 0


def answer(scene, config: Config) -> Answer:
    """What the pipeline says of one scene. The base's position is given, as a robot's user would."""
    config = config.replace(robot_radius=scene.radius, base_position=scene.base_position.tolist())
    result = reconstruct(scene.frame, config)
    return Answer(scene.seed, result.outcome, compare(result.shape.points, scene.truth) if result.shape else None)


def table(answers: dict[tuple[str, str], list[Answer]]) -> str:
    """A row a family and method; errors of the answered scenes in mm as mean / 95th percentile / worst."""
    columns = ('mean', 'missed', 'tip', 'length', 'matched')
    lines = [f'{"family":12s} {"method":8s} {"answered":>9s} {"silent":>6s} ' + ' '.join(f'{c + " (mean/p95/max mm)":>25s}' for c in columns) + '  rejections']
    for (family, method), rows in answers.items():
        good = [a.errors for a in rows if a.errors]
        cells = [_cell(np.array([getattr(e, c) for e in good]) * 1000) for c in columns]
        reasons = Counter(a.outcome.value for a in rows if not a.errors)
        lines.append(f'{family:12s} {method:8s} {len(good):4d}/{len(rows):4d} {sum(a.silent_failure for a in rows):6d} ' + ' '.join(cells)
                     + '  ' + ', '.join(f'{n} {r}' for r, n in reasons.most_common()))
    return '\n'.join(lines)


def _cell(mm: np.ndarray) -> str:
    return f'{"-":>25s}' if not len(mm) else f'{f"{mm.mean():.3f} / {np.percentile(mm, 95):.3f} / {mm.max():.3f}":>25s}'


def _plain(a: Answer) -> dict:
    return {'seed': a.seed, 'outcome': a.outcome.value, 'errors_m': dataclasses.asdict(a.errors) if a.errors else None}


if __name__ == '__main__':
    raise SystemExit(main())
