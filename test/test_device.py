"""Device files: what they say, all that can be wrong with them, and what the materials attenuate."""

import os
from pathlib import Path

import numpy as np
import pytest

from fluoro_shape_ros import device
from fluoro_shape_ros.device import (
    REST,
    Device,
    DeviceError,
    Piece,
    Ring,
    Segment,
    attenuation,
    load_device,
    presets,
    water_attenuation,
)
from fluoro_shape_ros.resources import resource_path

EXAMPLE = device.__doc__.split('\n\n')[1]
ROD = 'segments:\n  - {length: rest, radius: 0.001, material: metal}\n'


@pytest.fixture
def read(tmp_path):
    """The device of a text or of bytes."""
    def device_of(text):
        path = tmp_path / 'my.yaml'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_device(path)
    return device_of


def segment(**changes):
    """A file of one segment; None leaves an entry out."""
    entries = {'length': 'rest', 'radius': 0.001, 'material': 'metal'} | changes
    return f'segments:\n  - {{{", ".join(f"{k}: {v}" for k, v in entries.items() if v is not None)}}}\n'


def band(**changes):
    """A rod's file with one band."""
    entries = {'at': 0.01, 'length': 0.002, 'radius': 0.0012, 'material': 'platinum'} | changes
    return ROD + f'bands:\n  - {{{", ".join(f"{k}: {v}" for k, v in entries.items() if v is not None)}}}\n'


# ---- what a file says


def test_the_docstrings_example(read):
    expected = Device((Segment(0.060, 0.0007, 'metal', 0.0005), Segment(REST, 0.0010, 'metal', 0.0008)),
                      (Ring(0.002, 0.001, 0.00075, 'platinum'),))
    assert read(EXAMPLE) == expected
    assert expected.radius == 0.0007 and expected.widest == 0.0010 and expected.length == REST


def test_all_entries(read):
    found = read('''
segments:
  - {length: 0.05, radius: 1e-3, attenuation: 250}      # 1e-3 is text in YAML 1.1
  - &shaft {length: 0.2, radius: 0.0008, lumen: 0.0004, material: polymer}
  - {<<: *shaft, length: 0.1, material: metal}
bands:
disks:
  - {at: 0, length: 0.001, radius: 0.003, attenuation: 40.5, every: 0.01}
  - {at: 0.3, length: 0.1, radius: 0.0009, material: platinum}
''')
    segments = (Segment(0.05, 0.001, 250.0), Segment(0.2, 0.0008, 'polymer', 0.0004),
                Segment(0.1, 0.0008, 'metal', 0.0004))
    assert found == Device(segments, (), (Ring(0.0, 0.001, 0.003, 40.5, 0.01), Ring(0.3, 0.1, 0.0009, 'platinum')))
    assert found.length == pytest.approx(0.35) and found.radius == 0.001 and found.widest == 0.003


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16'])
def test_encodings(read, encoding):
    assert read(('# Führungsdraht\r\n' + ROD).encode(encoding)) == Device((Segment(REST, 0.001, 'metal'),))


# ---- parts


CANNULA = Device((Segment(0.060, 0.0007, 'metal', 0.0005), Segment(REST, 0.0010, 'metal', 0.0008)),
                 (Ring(0.002, 0.001, 0.00075, 'platinum'),))


@pytest.mark.parametrize('length, expected', [
    (0.1, [Piece(0, 0.06, 0.0007, 0.0005, 'metal'), Piece(0.06, 0.1, 0.0010, 0.0008, 'metal'),
           Piece(0.002, 0.003, 0.00075, 0.0007, 'platinum')]),
    (0.06, [Piece(0, 0.06, 0.0007, 0.0005, 'metal'), Piece(0.002, 0.003, 0.00075, 0.0007, 'platinum')]),
    (0.0025, [Piece(0, 0.0025, 0.0007, 0.0005, 'metal'), Piece(0.002, 0.0025, 0.00075, 0.0007, 'platinum')]),
    (0.001, [Piece(0, 0.001, 0.0007, 0.0005, 'metal')]),
], ids=['longer than its segments', 'up to the joint', 'ends in the band', 'ends before the band'])
def test_pieces(length, expected):
    assert CANNULA.pieces(length) == expected


def test_without_rest_the_last_segment_goes_on():
    two = Device((Segment(0.01, 0.001, 'metal'), Segment(0.02, 0.002, 200.0, 0.001)))
    assert two.pieces(0.05) == [Piece(0, 0.01, 0.001, 0, 'metal'), Piece(0.01, 0.05, 0.002, 0.001, 200.0)]
    assert two.pieces(0.02)[1] == Piece(0.01, 0.02, 0.002, 0.001, 200.0)


def test_a_ring_across_a_joint_stands_out_as_much_as_it_does_on_either_side():
    across = Device(CANNULA.segments, disks=(Ring(0.059, 0.003, 0.0012, 'polymer'),))
    first, second = across.pieces(0.1)[2:]
    assert first == Piece(0.059, 0.06, 0.0012, 0.0007, 'polymer')
    assert (second.start, second.radius, second.lumen) == (0.06, 0.0012, 0.0010) and second.stop == pytest.approx(0.062)


@pytest.mark.parametrize('length, ends', [
    (0.0241, [(0, 0.001), (0.008, 0.009), (0.016, 0.017), (0.024, 0.0241)]),
    (0.024, [(0, 0.001), (0.008, 0.009), (0.016, 0.017)]),
    (0.0165, [(0, 0.001), (0.008, 0.009), (0.016, 0.0165)]),
    (0.0005, [(0, 0.0005)]),
])
def test_rings_repeat_up_to_the_base(length, ends):
    tendon = Device((Segment(REST, 0.0005, 'metal'),), disks=(Ring(0.0, 0.001, 0.0025, 150.0, 0.008),))
    found = tendon.pieces(length)[1:]
    assert [(p.radius, p.lumen, p.material) for p in found] == [(0.0025, 0.0005, 150.0)] * len(ends)
    assert np.array([(p.start, p.stop) for p in found]) == pytest.approx(np.array(ends))


def test_pieces_fill_the_length_without_gaps():
    rng = np.random.default_rng(5)
    for _ in range(50):
        lengths = rng.uniform(0.001, 0.05, rng.integers(1, 8))
        spans = Device(tuple(Segment(float(x), 0.001, 'metal')
                             for x in lengths)).pieces(whole := float(rng.uniform(0.001, 0.3)))
        assert spans[0].start == 0 and spans[-1].stop == whole
        assert [p.start for p in spans[1:]] == [p.stop for p in spans[:-1]] and all(p.stop > p.start for p in spans)


def test_a_rounding_error_is_no_piece():
    """0.1 + 0.2 > 0.3: a ring at 0.3 m sits on the third segment only."""
    shaft = (Segment(0.1, 0.001, 'metal'), Segment(0.2, 0.002, 'metal'), Segment(REST, 0.001, 'metal'))
    found = Device(shaft, (Ring(0.3, 0.01, 0.0015, 'platinum'),)).pieces(0.4)
    assert len(found) == 4 and found[3].lumen == 0.001
    assert len(Device(shaft).pieces(0.3)) == 2


# ---- wrong files


WIDER = '  - {length: rest, radius: 0.002, material: metal}\n'
WRONG = {
    'empty': ('', 'no device: a list `segments` is needed'),
    'only a comment': ('# nothing\n', 'no device: a list `segments` is needed'),
    'a list': ('- 1\n- 2\n', 'no device: a list `segments` is needed'),
    'a number': ('42', 'no device: a list `segments` is needed'),
    'no segments': ('bands: []\n', 'no device: a list `segments` is needed'),
    'empty segments': ('segments: []\n', 'no device: a list `segments` is needed'),
    'segments a map': ('segments: {length: 1}\n', 'segments: must be a list'),
    'segments a word': ('segments: many\n', 'segments: must be a list'),
    'segment a number': ('segments: [1]\n', r'segments\[0\]: must be a map such as'),
    'bands a number': (ROD + 'bands: 0\n', 'bands: must be a list'),
    'disks false': (ROD + 'disks: false\n', 'disks: must be a list'),
    'ring a list': (ROD + 'disks: [[]]\n', r'disks\[0\]: must be a map such as'),
    'unknown at the top': (ROD + 'segmets: []\n', 'unknown: segmets; there are segments, bands, disks'),
    'unknown in a segment': (segment(every=0.1), r'segments\[0\]: unknown: every; there are length, radius, lumen, '
                                                 r'material, attenuation'),
    'unknown in a band': (band(lumen=0.0002), r'bands\[0\]: unknown: lumen; there are at, length, radius, every, '
                                              r'material, attenuation'),
    'unknown number': (segment() + '2: 3\n', 'unknown: 2; there are'),
    'many unknown': (ROD + ''.join(f'k{i}: 1\n' for i in range(20)), 'unknown: k0, k1, k10; there are'),
    'no length': (segment(length=None), r'segments\[0\]: length is missing'),
    'no radius': (segment(radius=None), r'segments\[0\]: radius is missing'),
    'no material': (segment(material=None), r'segments\[0\]: needs either material or attenuation'),
    'two materials': (segment(attenuation=100), r'segments\[0\]: needs either material or attenuation'),
    'no at': (band(at=None, radius=None), r'bands\[0\]: at, radius is missing'),
    'unknown material': (segment(material='wood'), r'segments\[0\]: no material is called wood: there are metal, '
                                                   r'platinum, polymer, or attenuation in 1/m'),
    'material a number': (segment(material=250), r'segments\[0\]: material must be a name, got 250; '
                                                 r'a number is called attenuation'),
    'material true': (segment(material='true'), r'segments\[0\]: material must be a name, got True'),
    'material none': (segment(material='~'), r'segments\[0\]: material must be a name, got None'),
    'material a list': (segment(material='[metal]'), r'segments\[0\]: material must be a name, got a list'),
    'text for a number': (segment(radius='thin'), r'segments\[0\]: radius must be a number, got thin'),
    'units': (segment(radius='1 mm'), r'segments\[0\]: radius must be a number, got 1 mm'),
    'true for a number': (segment(radius='true'), r'segments\[0\]: radius must be a number, got True'),
    'none for a number': (segment(radius='~'), r'segments\[0\]: radius must be a number, got None'),
    'list for a number': (segment(radius='[0.001]'), r'segments\[0\]: radius must be a number, got a list'),
    'date for a number': (segment(radius='2024-02-03'), r'segments\[0\]: radius must be a number, got datetime.date'),
    'nan': (segment(radius='.nan'), r'segments\[0\]: radius must be a number, got nan'),
    'text nan': (segment(radius='nan'), r'segments\[0\]: radius must be a number, got nan'),
    'infinite': (segment(length='.inf'), r'segments\[0\]: length must be a number, got inf'),
    'negative radius': (segment(radius=-0.001), r'segments\[0\]: radius must lie in \[1e-05, 0.01\] m, got -0.001'),
    'no radius at all': (segment(radius=0), r'segments\[0\]: radius must lie in .* got 0'),
    'in millimetres': (segment(radius=0.6), r'segments\[0\]: radius must lie in .* got 0.6'),
    'negative length': (segment(length=-1), r'segments\[0\]: length must lie in .* got -1'),
    'no length at all': (segment(length=0), r'segments\[0\]: length must lie in .* got 0'),
    'too long': (segment(length=60), r'segments\[0\]: length must lie in \[1e-05, 10\] m.* got 60'),
    'rest is not the last': (segment() + '  - {length: 0.1, radius: 0.001, material: metal}\n',
                             r'segments\[0\]: length must .* `rest` in the last segment, got rest'),
    'lumen as wide': (segment(lumen=0.001), r'segments\[0\]: lumen, a radius in m, '
                                            r'must lie in \[0, radius\), got 0.001'),
    'negative lumen': (segment(lumen=-0.0001), r'segments\[0\]: lumen, .* got -0.0001'),
    'the second one': (segment(length=0.1) + '  - {length: rest, radius: 7, material: metal}\n',
                       r'segments\[1\]: radius must lie'),
    'no attenuation': (segment(material=None, attenuation=0),
                       r'segments\[0\]: attenuation must lie in \(0, 1e6\) 1/m, got 0'),
    'negative attenuation': (band(material=None, attenuation=-5), r'bands\[0\]: attenuation must lie in .* got -5'),
    'attenuation nan': (segment(material=None, attenuation='.nan'),
                        r'segments\[0\]: attenuation must be a number, got nan'),
    'attenuation a name': (segment(material=None, attenuation='metal'),
                           r'segments\[0\]: attenuation must be a number, got metal'),
    'too much attenuation': (segment(material=None, attenuation='1.0e+7'),
                             r'segments\[0\]: attenuation must lie in .* got 1e\+07'),
    'band before the tip': (band(at=-0.001), r'bands\[0\]: at must lie in \[0, 10\] m, got -0.001'),
    'band of no length': (band(length=0), r'bands\[0\]: length must lie in .* got 0'),
    'band without end': (band(length='rest'), r'bands\[0\]: length must be a number, got rest'),
    'band too wide': (band(radius=0.5), r'bands\[0\]: radius must lie in .* got 0.5'),
    'band inside': (band(radius=0.001), r'bands\[0\]: radius 0.001 m does not stand out from the segment that it sits '
                                        r'on, of 0.001 m'),
    'band meets itself': (band(every=0.001), r'bands\[0\]: every must lie in \[length, 10\] m, got 0.001'),
    'every is negative': (band(every=-1), r'bands\[0\]: every must lie in .* got -1'),
    'beyond the device': (band(at=0.3).replace('rest', '0.3'),
                          r'bands\[0\]: begins at 0.3 m from the tip, but the device is 0.3 m long'),
    'narrow on the second': (segment(length=0.02) + WIDER
                             + 'bands:\n  - {at: 0.019, length: 0.002, radius: 0.0015, material: metal}\n',
                             r'bands\[0\]: radius 0.0015 m does not stand out .* of 0.002 m'),
    'narrow when repeated': (segment(length=0.02) + WIDER
                             + 'disks:\n  - {at: 0, length: 0.001, radius: 0.0015, every: 0.005, material: metal}\n',
                             r'disks\[0\]: radius 0.0015 m does not stand out .* of 0.002 m'),
    'rings without number': (band(length='1e-5', every='1e-5'),
                             r'bands and disks: those that repeat \(every\) come more than once in 0.0001 m'),
    'rings without length': (band(length='1e-9', every='1e-9'), r'bands\[0\]: length must lie in'),
    'not yaml': ('segments: [', 'not YAML: while parsing a flow node, .* line 1'),
    'a tab': ('segments:\n\t- 1\n', 'not YAML: while scanning for the next token, found character .* line 2'),
    'two documents': (f'{ROD}---\n{ROD}', 'not YAML: expected a single document .* line 3'),
    'twice': (ROD + 'bands: []\n' + 'bands: []\n', 'not YAML: bands is there twice, line 1'),
    'a key twice': ('segments:\n  - {length: rest, radius: 0.001, radius: 0.002, material: metal}\n',
                    'not YAML: radius is there twice, line 2'),
    'a tag of python': ('segments: !!python/object/apply:os.system ["exit"]\n',
                        'not YAML: could not determine a constructor for the tag .*python'),
    'no such date': ('segments: 2024-13-45\n', 'not YAML: month must be in 1..12'),
    'a wrong tag': ('segments: !!int many\n', 'not YAML: invalid literal'),
    'a wrong bool': ('segments: !!bool many\n', 'not YAML: '),
    'a wrong time': ('segments: !!timestamp many\n', 'not YAML: '),
    'an empty number': ('segments: !!int ""\n', 'not YAML: '),
    'undefined alias': ('segments: *nothing\n', "not YAML: found undefined alias 'nothing', line 1"),
    'a key of two lines': ('"a\\nb": 1\n', r"unknown: 'a\\nb'; there are"),
    'a long name': (segment(material='m' * 9000), r'segments\[0\]: no material is called m{40}\.\.\.: there are'),
    'very many digits': (segment(radius='9' * 5000), 'not YAML: |radius must be a number'),
    'very large in hex': (segment(radius='0x' + 'f' * 5000), 'radius must be a number, got a huge number'),
    'larger than floats': (segment(radius='9' * 400), 'radius must be a number, got 99999'),
    'sexagesimal': (segment(radius='1' + ':59' * 9000 + '.0'), 'not YAML: |must be a number'),
    'nul': (b'\0\0\0\0', 'not YAML: unacceptable character'),
    'a picture': (b'\x89PNG\r\n\x1a\n\0\0\0\rIHDR', 'not YAML: unacceptable character'),
    'bytes': (bytes(range(128, 256)), 'not YAML: unacceptable character'),
    'half of utf-16': (b'\xff\xfea', 'not YAML: unacceptable character'),
    'large': ('#' * 70000 + '\n' + ROD, 'larger than 65536 bytes'),
    'deep brackets': ('[' * 60000, 'not YAML: nested too deep'),
    'deep braces': ('{a: ' * 15000, 'not YAML: nested too deep'),
    'deep dashes': ('- ' * 30000, 'not YAML: nested too deep'),
    'many keys': ('\n'.join(f'k{i}: 1' for i in range(101)), 'not YAML: more than 100 keys'),
    'many segments': ('segments: [' + 'a, ' * 1001 + ']', 'segments: more than 1000 entries'),
    'in itself': ('segments: &s [*s]\n', r'segments\[0\]: must be a map'),
}


@pytest.mark.parametrize('text, message', WRONG.values(), ids=WRONG.keys())
def test_wrong_files_are_refused_in_one_line(read, tmp_path, text, message):
    with pytest.raises(DeviceError, match=message) as refused:
        read(text)
    line = str(refused.value)
    assert line.startswith(f'{tmp_path}/my.yaml: ') and line.isprintable() and len(line) < len(str(tmp_path)) + 300
    assert 'Error' not in line and 'Traceback' not in line


def test_aliases_of_aliases_take_no_time_and_no_room(read):
    """Nine of the one before, twelve times: 9^12 entries for whoever writes them all out, and as many keys where they
    are merged."""
    lists = 'bands: &a0 [x]\n' + ''.join(f'k{i}: &a{i + 1} [{", ".join([f"*a{i}"] * 9)}]\n' for i in range(12))
    with pytest.raises(DeviceError, match='unknown: k0, k1, k10'):
        read(lists)
    with pytest.raises(DeviceError, match=r'segments\[0\]: radius must be a number, got a list'):
        read(segment(radius='&r [*r, *r]'))
    merged = 'segments:\n  - &m0 {a: 1, b: 1}\n' + ''.join(f'  - &m{i + 1} {{<<: [{", ".join([f"*m{i}"] * 9)}]}}\n'
                                                           for i in range(12))
    # PyYAML has learnt to drop what is merged twice
    with pytest.raises(DeviceError, match=r'more than 100 keys|segments\[0\]'):
        read(merged)


def test_no_garbled_file_raises_anything_else(read):
    text = np.frombuffer(resource_path('device_ep.yaml').read_bytes(), np.uint8)
    rng, refused = np.random.default_rng(2), 0
    for _ in range(150):
        garbled = text.copy()
        at = rng.integers(0, len(text), rng.integers(1, 6))
        garbled[at] = rng.choice(np.frombuffer(b'{}[]:,-&*!|>%@"\'#?\n\t 0~.e9\xff\x00', np.uint8), len(at))
        try:
            assert read(bytes(garbled)).pieces(0.2)
        except DeviceError as error:
            assert str(error).isprintable()
            refused += 1
    assert 30 < refused < 150


@pytest.mark.parametrize('wrong', [
    dict(segments=()), dict(segments=(Segment(0.1, float('nan'), 'metal'),)),
    dict(segments=(Segment(float('nan'), 0.001, 'metal'),)),
    dict(segments=(Segment(REST, 0.001, 'metal', float('nan')),)), dict(segments=(Segment(REST, 0.001, True),)),
    dict(segments=(Segment(REST, 0.001, float('nan')),)),
    dict(segments=(Segment(REST, 0.001, 'metal'),), bands=(Ring(float('nan'), 0.001, 0.002, 'metal'),)),
    dict(segments=(Segment(REST, 0.001, 'metal'),), disks=(Ring(0.0, 0.001, 0.002, 'metal', float('nan')),)),
])
def test_devices_that_can_not_be_are_refused_without_a_file_too(wrong):
    with pytest.raises(DeviceError):
        Device(**wrong)


# ---- where files are found


def test_paths(tmp_path, monkeypatch):
    rod = Device((Segment(REST, 0.001, 'metal'),))
    (tmp_path / 'mine').write_text(ROD)
    monkeypatch.setenv('HOME', str(tmp_path))
    assert load_device(tmp_path / 'mine') == load_device(str(tmp_path / 'mine')) == load_device('~/mine') == rod
    monkeypatch.chdir(tmp_path)
    assert load_device('mine') == load_device('./mine') == rod


@pytest.mark.parametrize('name', ['', 'nothing', '/no/such/file', '~', '~nobody-of-this-name/x', '.', '..', 'rod/',
                                  '../resource/rod', 'x' * 5000, 'a\0b', 'a\nb'])
def test_what_is_not_there_is_refused_with_what_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DeviceError, match='no such file, nor a device .* there are braided, cannula, ') as refused:
        load_device(name)
    assert str(refused.value).isprintable() and len(str(refused.value)) < 400


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    for path in (tmp_path, tmp_path / 'pipe', Path('/dev/zero')):
        with pytest.raises(DeviceError, match='no such file'):
            load_device(path)


@pytest.mark.skipif(os.geteuid() == 0, reason='root may read all')
def test_what_may_not_be_read(tmp_path):
    (tmp_path / 'mine').write_text(ROD)
    (tmp_path / 'mine').chmod(0)
    with pytest.raises(DeviceError, match="mine: can't be read: Permission denied"):
        load_device(tmp_path / 'mine')


# ---- presets


def test_presets_are_the_files():
    folder = resource_path('device_rod.yaml').parent
    assert presets() == sorted(p.name[7:-5] for p in folder.glob('device_*.yaml')) and len(presets()) >= 8
    for name in presets():
        path = folder / f'device_{name}.yaml'
        assert (load_device(name) == load_device(f'device_{name}') == load_device(f'device_{name}.yaml')
                == load_device(path))
        assert path.read_text().startswith('# A')


@pytest.mark.parametrize('name', presets())
def test_presets_are_devices(name):
    preset = load_device(name)
    assert 1e-4 < preset.radius <= preset.widest < 3e-3 and preset.length == REST
    shaft = preset.segments[-1]
    assert 1 - np.exp(-attenuation(shaft.material, 70) * 2 * (shaft.radius - shaft.lumen)) > 0.04      # can be seen


def test_presets_are_what_they_say():
    """French: a third of a millimetre in diameter."""
    d = {name: load_device(name) for name in presets()}
    assert d['rod'].segments == (Segment(REST, 0.00055, 'metal'),) and d['rod'].widest == 0.00055
    assert [(2 * s.radius, 2 * s.lumen) for s in d['tube'].segments] == [(0.0020, 0.0015)]
    walls = [s.radius - s.lumen for s in (*d['cannula'].segments, *d['cannula3'].segments)]
    assert walls == pytest.approx([0.0002, 0.0004, 0.00015, 0.00035, 0.00055])  # each tube's, and of those inside it
    assert d['cannula'].segments[0].length == 0.060
    assert [len(d[name].bands) for name in ('ep', 'braided', 'tendon')] == [3, 1, 0]
    assert (2 * d['ep'].widest == pytest.approx(7 / 3 * 1e-3, rel=0.03) and d['ep'].segments[0].material == 'platinum'
            and d['ep'].segments[0].length == 0.004)
    assert 2 * d['braided'].disks[0].radius == pytest.approx(6 / 3 * 1e-3, rel=0.03)
    assert (d['braided'].disks[0].every, d['braided'].disks[0].at > 0.006) == (0.0012, True)
    assert 2 * d['coil'].radius == 0.0009 and d['coil'].segments[0].length == 0.030
    assert d['tendon'].disks[0].every == 0.008 and d['tendon'].segments[0].material == 'metal'


# ---- attenuation


@pytest.mark.parametrize('material, energy_kev, expected', [
    ('metal', 60, 742.0),           # 6.45 (0.558 * 1.512 + 0.442 * 0.7661) - 0.2059 = 7.420 1/cm
    ('metal', 50, 1213.5),          # 6.45 (0.558 * 2.474 + 0.442 * 1.213) - 0.2269 = 12.135
    ('platinum', 60, 9286.6),       # 21.45 * 4.339 - 0.2059 = 92.866
    ('platinum', 100, 10692.9),     # 21.45 * 4.993 - 0.1707 = 106.929
    ('polymer', 60, 55.0),          # 1.10 (0.9 * 0.1952 + 0.1 * 5.116) - 0.2059 = 0.550
    ('metal', np.sqrt(50 * 60), 948.9),     # log-log: the geometric means of both
    ('platinum', 78.39, 4709.1),    # below the K edge 21.45 * 2.204 - 0.185 = 47.091
    ('platinum', 78.40, 20086.6),   # above it 21.45 * 9.373 - 0.185 = 200.866
    (100.0, 60, 100.0),
    (100.0, 80, 48.53),             # as metal: 6.45 (0.558 * 0.7306 + 0.442 * 0.4052) - 0.1837 = 3.601 of 7.420
])
def test_attenuation(material, energy_kev, expected):
    assert attenuation(material, energy_kev) == pytest.approx(expected, rel=1e-3)


def test_water_attenuation():
    assert water_attenuation(60) == pytest.approx(20.59) and water_attenuation(100) == pytest.approx(17.07)
    assert water_attenuation(np.sqrt(40 * 50)) == pytest.approx(100 * np.sqrt(0.2683 * 0.2269))


def test_attenuation_falls_with_energy_but_for_the_k_edge_of_platinum():
    energies = np.arange(40.0, 100.1, 0.5)
    for material in ('metal', 'polymer', 'platinum', 100.0):
        rises = energies[1:][np.diff([attenuation(material, e) for e in energies]) >= 0]
        assert rises.tolist() == ([78.5] if material == 'platinum' else [])
    assert attenuation('platinum', 78.0) < 0.3 * attenuation('platinum', 79.0)


@pytest.mark.parametrize('energy_kev', [0, -60, 39.9, 100.1, 6e4, float('nan'), float('inf')])
def test_energies_beyond_the_table_are_refused(energy_kev):
    for known in (lambda e: attenuation('metal', e), lambda e: attenuation(100.0, e), water_attenuation):
        with pytest.raises(DeviceError, match='attenuation is known from 40 to 100 keV, not at'):
            known(energy_kev)
