"""A page in a real headless Chromium: what test_report.py stands on."""

import html
import json
import re
import shutil
import subprocess
from urllib.parse import unquote

CHROMIUM = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None)
# no network; time runs only while the page has nothing to do; WebGL in software, as there need not be a graphics card
OPTIONS = ('--headless', '--no-sandbox', '--disable-dev-shm-usage', '--no-first-run', '--use-angle=swiftshader',
           '--enable-unsafe-swiftshader', '--host-resolver-rules=MAP * ~NOTFOUND', '--enable-logging=stderr',
           '--window-size=1400,1500', '--virtual-time-budget=300000')
CATCH = '''<script>
window.problems = [];
window.onerror = message => { problems.push(String(message)); };
window.onunhandledrejection = event => { problems.push(String(event.reason)); };
console.error = (...words) => { problems.push(words.join(' ')); };
const until = async condition => { while (!condition()) await new Promise(done => setTimeout(done, 50)); };
</script>'''
DRIVE = '''<script>(async () => {
let answer = null;
try { answer = await (async () => { %s })(); } catch (error) { problems.push(String(error)); }
const out = document.createElement('pre');
out.id = 'answer';
out.textContent = encodeURIComponent(JSON.stringify([answer, problems]));
top.document.documentElement.replaceChildren(out);
})();</script>'''


def visit(page, script, folder, width=None):
    """What `script` (the body of an async JavaScript function, which may `await until(() => condition)`) returns in
    `page`, and the page's errors.

    The page is `width` px wide: in a frame, as Chromium's own window has at least 500 px.
    """
    copy = folder / 'visited.html'
    head, rest = page.read_text(encoding='utf-8').split('<head>', 1)
    body, end = rest.rsplit('</body>', 1)
    text = f'{head}<head>{CATCH}{body}{DRIVE % script}</body>{end}'
    if width is not None:
        text = (f'<body style="margin: 0"><iframe style="border: 0; width: {width}px; '
                f'height: 900px" srcdoc="{html.escape(text)}"></iframe></body>')
    copy.write_text(text, encoding='utf-8')
    done = subprocess.run([CHROMIUM, *OPTIONS, f'--user-data-dir={folder / "profile"}', '--dump-dom', copy.as_uri()],
                          capture_output=True, text=True, timeout=240)
    found = re.search(r'<pre id="answer">([^<]*)</pre>', done.stdout)
    assert found, f'no answer ({done.returncode}): {done.stdout[-500:]} {done.stderr[-3000:]}'
    answer, problems = json.loads(unquote(found[1]))
    return answer, problems + re.findall(r'ERROR:CONSOLE.*|.*(?:Failed to load|Uncaught).*', done.stderr)
