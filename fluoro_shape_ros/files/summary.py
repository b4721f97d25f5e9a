"""What became of a replayed bag, for people and for programs."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from msg_adapters.messages import short

from .offline import Summary

REASONS = 3     # of an outcome, that are shown in words


def as_json(summary: Summary) -> dict:
    """The summary for programs."""
    return {'pairs': summary.counts.pairs, 'images': dict(summary.images), 'masked': summary.masked,
            'outcomes': dict(summary.outcomes.most_common()),
            'reasons': [{'outcome': outcome, 'why': why, 'pairs': n}
                        for (outcome, why), n in summary.reasons.most_common()],
            'warnings': dict(summary.warnings.most_common()),
            'calibration_watch': {**asdict(summary.calibration), 'words': str(summary.calibration)}}


def report(summary: Summary, out: str) -> str:
    """The summary for people."""
    c = summary.counts
    lines = [f'{c.pairs} pairs of {summary.images["a"]} images of plane A and {summary.images["b"]} of plane B; '
             f'results in {out}']
    if summary.masked:
        lines.append(f'{summary.masked:7d}  made the mask')
    for name, n in summary.outcomes.most_common():
        lines.append(f'{n:7d}  {name}')
        why = Counter({words: k for (outcome, words), k in summary.reasons.items() if outcome == name}).most_common()
        lines += [f'{k:13d}  {words}' for words, k in why[:REASONS]]
        if len(why) > REASONS:
            lines.append(f'{sum(k for _, k in why[REASONS:]):13d}  other reasons')
    lines += [f'{n:7d}  {name}' for name, n in summary.warnings.most_common()]
    lost = {'unpaired': c.unpaired, 'duplicate': c.duplicates, 'out of order': c.out_of_order,
            'without a stamp': c.unstamped}
    if any(lost.values()):
        lines.append('images ' + ', '.join(f'{what}: {n}' for what, n in lost.items() if n))
    if c.jumps:
        lines.append(f'stamps jumped back: {c.jumps} times')
    lines.append(f'calibration watch: {summary.calibration}')
    lines += [f'camera infos refused: {reason}' for _, reason in sorted(summary.refused.items())]
    lines += [f'plane {plane.upper()}: its images are of frame "{short(image)}", '
              f'its camera info of "{short(info)}": are the calibrations exchanged?'
              for plane, (image, info) in sorted(summary.frames.items())]
    return '\n'.join(lines)
