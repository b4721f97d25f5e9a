"""README, CONTRIBUTING and docs/: short enough, every link leads somewhere, what they name is there, and the picture of
the stages can be drawn."""

import re
import runpy
from functools import cache
from pathlib import Path

import pytest
from test_package import EXECUTABLES

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / 'docs').glob('*.md'))
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *DOCS]
LINK = re.compile(r'!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)')
FENCED, CODE = re.compile(r'^```.*?^```$', re.DOTALL | re.MULTILINE), re.compile(r'`[^`\n]+`')
INCLUDED = re.compile(r'^```\{include\} (\S+)$', re.MULTILINE)


@cache
def text(page: Path) -> str:
    return page.read_text(encoding='utf-8')


def prose(page: Path) -> str:
    """A page without what stands in code, which may look like a link."""
    return CODE.sub('``', FENCED.sub('', text(page)))


def links(page: Path) -> list[str]:
    """Where a page leads to inside the repository."""
    return [target for target in LINK.findall(prose(page)) if not re.match('[a-z]+:', target)]


@cache
def anchors(page: Path) -> set[str]:
    """What GitHub, and Sphinx with MyST, call the headings of a page and of what it includes: small letters, no
    punctuation, hyphens for blanks."""
    own = re.findall(r'^#+ (.+)$', FENCED.sub('', text(page)), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-')
            for heading in own}.union(*(anchors(page.parent / other) for other in INCLUDED.findall(text(page))))


def dead(page: Path) -> list[str]:
    """The links of a page that lead nowhere."""
    found = []
    for target in links(page):
        file, _, anchor = target.partition('#')
        other = (page.parent / file).resolve() if file else page
        if not other.exists() or (anchor and (other.suffix != '.md' or anchor not in anchors(other))):
            found.append(target)
    return found


def test_readme_is_short():
    assert len(text(PAGES[0]).splitlines()) <= 200


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    assert dead(page) == []


def test_links_and_anchors_are_found(tmp_path):
    (tmp_path / 'b.md').write_text('# What `P` must (not) contain\n\n```sh\n# no heading\n```\n')
    page = tmp_path / 'a.md'
    page.write_text('# A\n[1](b.md) [2](b.md#what-p-must-not-contain) [3](b.md#no-heading) [4](c.md) '
                    '[5](https://x.org/y) ![6](d.png) [[7]](#a) [8](#b)\n`f[0](9)`\n```\n[10](e.md)\n```\n')
    assert links(page) == ['b.md', 'b.md#what-p-must-not-contain', 'b.md#no-heading', 'c.md', 'd.png', '#a', '#b']
    assert dead(page) == ['b.md#no-heading', 'c.md', 'd.png', '#b']


def test_readme_and_docs_name_every_executable():
    told = text(ROOT / 'docs' / 'get_started.md'), text(PAGES[0])
    assert [name for name in EXECUTABLES if any(f'`{name}`' not in page for page in told)] == []


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_files_that_are_named_are_there(page):
    """`method/fit/fit.py` of the package, of resource/ or of the repository; `test_node.py` anywhere in test/."""
    homes = ROOT, ROOT / 'fluoro_shape_ros', ROOT / 'resource'
    named = sorted({name.replace('share/fluoro_shape_ros/', 'resource/')
                    for name in re.findall(r'`([\w/]+\.py)`', text(page))})
    assert [name for name in named if not any((home / name).exists() for home in homes)
            and ('/' in name or not any((ROOT / 'test').rglob(name)))] == []


def test_every_page_is_in_the_index():
    trees = re.findall(r'```\{toctree\}\n(?::[^\n]*\n)*\n(.+?)```', text(ROOT / 'docs' / 'index.md'), re.DOTALL)
    assert (sorted(name for tree in trees for name in re.findall(r'(\w+)>?$', tree, re.MULTILINE))
            == sorted(page.stem for page in DOCS if page.stem != 'index'))


def test_the_picture_of_the_stages_is_drawn(tmp_path):
    cv2 = pytest.importorskip('cv2')
    pytest.importorskip('matplotlib')
    assert runpy.run_path(str(ROOT / 'docs' / 'draw_stages.py'))['main'](['--size', '384', '--out',
                                                                          str(tmp_path / 'stages.png')]) == 0
    drawn, shown = cv2.imread(str(tmp_path / 'stages.png')), cv2.imread(str(ROOT / 'docs' / 'stages.png'))
    assert drawn.shape == shown.shape and drawn.std() > 20
    assert (ROOT / 'docs' / 'stages.png').stat().st_size < 300_000
