"""Known vulnerabilities of what is installed beside this Python: pip-audit where it can run, else "not audited".

`python .ci/audit.py` exits with 1 where a release without the vulnerability exists, which our bounds must then not keep out.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main() -> int:
    frozen = subprocess.run([sys.executable, '-m', 'pip', 'freeze', '--exclude', 'fluoro_shape_ros', '--exclude-editable'], capture_output=True, text=True, check=True).stdout
    with tempfile.TemporaryDirectory() as folder:
        listed, found, own = Path(folder) / 'installed.txt', Path(folder) / 'found.json', Path(folder) / 'venv'
        listed.write_text(''.join(f'{line}\n' for line in frozen.splitlines() if '==' in line))
        pip_audit = [own / 'bin' / 'pip-audit', '-r', listed, '--no-deps', '--disable-pip', '--progress-spinner', 'off', '--format', 'json', '--output', found]
        for command in ([sys.executable, '-m', 'venv', own], [own / 'bin' / 'pip', 'install', '-q', 'pip-audit'], pip_audit):
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=300)
            except subprocess.TimeoutExpired:
                return skip('it took too long')
            if done.returncode and not found.exists():
                return skip((done.stderr.strip() or 'no reason given').splitlines()[-1])
        packages = json.loads(found.read_text())['dependencies']
    known = [p for p in packages if 'vulns' in p]
    if not known:
        return skip(f'none of {len(packages)} packages could be looked up')
    bad = [(p, v) for p in known for v in p['vulns']]
    for p, v in bad:
        print(f'{p["name"]} {p["version"]}: {v["id"]}, mended in {", ".join(v["fix_versions"]) or "no release yet"}')
    print(f'{len(known)} of {len(packages)} packages audited, {len(bad)} known vulnerabilities')
    return int(any(v['fix_versions'] for _, v in bad))


def skip(reason: str) -> int:
    print(f'not audited: {reason}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
