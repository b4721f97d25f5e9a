"""Known vulnerabilities of what is installed beside this Python, by pip-audit; "not audited" where PyPI's service for
that can't be reached.

`python .ci/audit.py` exits with 1 where a release without the vulnerability exists, which our bounds must then not keep
out, and where the service answers but the audit does not work: that a vulnerable release, which is not installed, is
found proves that it does.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

CANARY = 'django', '2.0'
PROBE = ('import requests, sys; answer = requests.get(sys.argv[1], timeout=60); answer.raise_for_status(); '
         'assert answer.json()["vulnerabilities"]')


def main() -> int:
    frozen = run(sys.executable, '-m', 'pip', 'freeze', '--exclude', 'fluoro_shape_ros', '--exclude-editable').stdout
    installed = [line for line in frozen.splitlines() if '==' in line]
    with tempfile.TemporaryDirectory() as folder:
        listed, found, own = Path(folder) / 'installed.txt', Path(folder) / 'found.json', Path(folder) / 'venv'
        listed.write_text('\n'.join([*installed, '=='.join(CANARY)]))
        run(sys.executable, '-m', 'venv', own)
        run(own / 'bin' / 'pip', 'install', '-q', 'pip-audit')
        probe = run(own / 'bin' / 'python', '-c', PROBE, 'https://pypi.org/pypi/{}/{}/json'.format(*CANARY),
                    check=False)     # as pip-audit asks
        if probe.returncode:
            print(f'not audited: {probe.stderr.strip().splitlines()[-1]}')
            return 0
        audit = run(own / 'bin' / 'pip-audit', '-r', listed, '--no-deps', '--disable-pip', '--progress-spinner', 'off',
                    '--format', 'json', '--output', found, check=False)
        if not found.exists():
            raise SystemExit(f'pip-audit failed: {audit.stderr.strip()}')
        return judge(json.loads(found.read_text())['dependencies'])


def run(*command, check: bool = True) -> subprocess.CompletedProcess:
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    if check and done.returncode:
        raise SystemExit(f'{" ".join(map(str, command))} failed: {done.stderr.strip()}')
    return done


def judge(packages: list[dict]) -> int:
    """The exit code for what pip-audit says of each package, which is printed."""
    ours = [p for p in packages if p['name'] != CANARY[0]]
    known = [p for p in ours if 'vulns' in p]
    if not known or not any(p.get('vulns') for p in packages if p['name'] == CANARY[0]):
        raise SystemExit('the audit does not work: {} {}, which is vulnerable, was not found'.format(*CANARY))
    bad = [(p, v) for p in known for v in p['vulns']]
    for p, v in bad:
        print(f'{p["name"]} {p["version"]}: {v["id"]}, mended in {", ".join(v["fix_versions"]) or "no release yet"}')
    print(f'{len(known)} of {len(ours)} packages audited, {len(bad)} known vulnerabilities')
    for p in ours:
        if 'vulns' not in p:
            print(f'not audited: {p["name"]}: {p.get("skip_reason", "no reason given")}')
    return int(any(v['fix_versions'] for _, v in bad))


if __name__ == '__main__':
    sys.exit(main())
