"""What is shown, as Rerun's archetypes by entity path: pure functions of arrays, nothing of topics or time.

Lengths are in m in the reference frame, but in the close-up of the tip: there they are in mm from it, along the same
axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from ..data import Outcome, Shape, View
from ..geometry.cameras import decompose, depth, distort, isocenter, project, source
from ..geometry.curve import arc_length, at_arc_length, even_steps
from ..overlay import FOUND, GOOD, REJECTED, SEEN, TIP, tip_ellipse

Scene = dict[str, object]   # entity path below that of the node -> archetype

CONFIDENCE = 0.95           # of the tip's ellipsoid and ellipses
DETECTOR_AT = 1.45          # of the distance from source to isocentre: P does not tell where the detector stands
CLOSE_UP = 2e-3             # m of the curves before the tip in its close-up
UNKNOWN = 1.0               # m^2: a variance that large stands for "unknown"
LINE, THIN, BALL = (rr.Radius.ui_points(width) for width in (2.0, 1.2, 5.0))    # on the screen, at any distance
RING_PX = 10.0              # radius of the ring that shows where the tip is
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 75]
GREY = '#9aa0a6'
CURVES = {'confidence': 'confidence', 'millimetres': 'sigma and error, mm', 'milliseconds': 'latency, ms',
          'pairs': 'pairs by outcome'}    # plots
SERIES = {  # entity -> name in the plot, colour, and whether each value stands for itself
    'confidence/published': ('published', GOOD, True),
    'confidence/refused': ('refused', REJECTED, True),
    'millimetres/tip_sigma': ('sigma, tip', TIP, False),
    'millimetres/sigma': ('sigma, median', FOUND, False),
    'millimetres/tip_error': ('error, tip', '#ff9da0', False),
    'millimetres/error': ('error, mean', GOOD, False),
    'milliseconds/node': ('in the node', FOUND, False),
    'milliseconds/here': ('stamp to this view', GREY, False),
}
OTHERS = ('#ffb347', '#c58bff', '#ff5a5f', '#f2e26b', '#6fa8ff', '#b0b0b0')     # of outcomes without a result, in turn


# ---- where things are


def cameras(views: tuple[View, View]) -> Scene:
    """Sources and detectors of both planes, with the images on them: these are below `plane_a` and `plane_b`, which are
    pinholes.

    Rerun knows no pinhole that mirrors: the detector of a mirrored image stays empty.
    """
    center = isocenter(views)
    scene = {}
    for view in views:
        K, R, _ = decompose(view.P)
        start, distance = source(view.P), DETECTOR_AT * abs(float(depth(view.P, center)))
        outline = detector(view, distance)
        edges = [outline, *([start, corner] for corner in outline[:4])]
        scene[f'source_{view.name}'] = rr.Points3D([start], radii=BALL, colors=rgb(SEEN),
                                                   labels=[f'source {view.name.upper()}'])
        scene[f'detector_{view.name}'] = rr.LineStrips3D(edges, radii=THIN, colors=rgb(SEEN))
        if K[0, 0] > 0:
            scene[f'plane_{view.name}'] = [rr.Pinhole(image_from_camera=K, width=view.width, height=view.height,
                                                      image_plane_distance=distance), *placed(start, R.T)]
    return scene


def placed(origin: np.ndarray, axes: np.ndarray) -> list:
    """An entity's place: its origin (3,) m and axes (3, 3), the columns, in the reference frame; Rerun is not to draw
    these axes, for which it has two ways."""
    if hasattr(rr, 'TransformAxes3D'):
        return [rr.Transform3D(translation=origin, mat3x3=axes), rr.TransformAxes3D(0.0)]
    return [rr.Transform3D(translation=origin, mat3x3=axes, axis_length=0.0)]


def detector(view: View, distance: float) -> np.ndarray:
    """(5, 3) m, the closed outline of the image at a `distance` in m from the source along the viewing axis."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]) * (view.width, view.height) - 0.5
    return source(view.P) + distance * np.linalg.solve(view.P[:, :3], np.c_[corners, np.ones(5)].T).T


def upright(view: View) -> Scene:
    """The axis of the reference frame that points most nearly upwards in the image of `view` is up."""
    up = -decompose(view.P)[1][1]
    axis = int(np.abs(up).argmax())
    axes = getattr(rr.ViewCoordinates, f'RIGHT_HAND_{"XYZ"[axis]}_{"UP" if up[axis] > 0 else "DOWN"}')
    return {'': axes, 'tip': axes}


def picture(plane: str, image: np.ndarray) -> Scene:
    """An (H, W) uint8 or (H, W, 3) BGR uint8 image of plane 'a' or 'b', as JPEG: a minute of two 1024 x 1024 streams
    would fill 2 GB else."""
    return {f'plane_{plane}/picture': rr.EncodedImage(contents=cv2.imencode('.jpg', image, JPEG)[1].tobytes(),
                                                      media_type='image/jpeg', draw_order=-10.0)}


# ---- what was found


def backbone(points: np.ndarray) -> Scene:
    """(N, 3) backbone, base to tip."""
    return {'device/backbone': strip(points, LINE, FOUND),
            'device/tip': rr.Points3D(points[-1:], radii=BALL, colors=rgb(TIP)),
            'tip/backbone': strip(close_up(points, points[-1]), LINE, FOUND)}


def ellipsoid(tip: np.ndarray, covariance: np.ndarray) -> Scene:
    """Where the tip (3,) lies with CONFIDENCE by its (3, 3) covariance, m^2; cleared where that is not known."""
    if not np.isfinite(covariance).all() or np.trace(covariance) > UNKNOWN:
        return {'device/ellipsoid': rr.Clear(recursive=False), 'tip/ellipsoid': rr.Clear(recursive=False)}
    variance, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.linalg.det(axes)   # a rotation, no mirror
    half = np.sqrt(np.maximum(variance, 0.0) * chdtri(3, 1 - CONFIDENCE))
    look = dict(quaternions=Rotation.from_matrix(axes).as_quat()[None], colors=rgb(TIP),
                fill_mode=rr.components.FillMode.MajorWireframe)
    return {'device/ellipsoid': rr.Ellipsoids3D(centers=[tip], half_sizes=[half], **look),
            'tip/ellipsoid': rr.Ellipsoids3D(centers=[(0.0, 0.0, 0.0)], half_sizes=[1e3 * half],
                                             line_radii=THIN, **look)}


def truth(points: np.ndarray, tip: np.ndarray | None) -> Scene:
    """(N, 3) true backbone, as a simulator knows it; seen from the `tip` (3,) that was found, where one was."""
    scene = {'truth': strip(points, THIN, GOOD)}
    if tip is not None:
        near = close_up(points, tip)
        scene |= {'tip/truth': strip(near, LINE, GOOD),
                  'tip/true_tip': rr.Points3D(near[-1:], radii=BALL, colors=rgb(GOOD))}
    return scene


def drawn(view: View, points: np.ndarray) -> Scene:
    """(N, 3) backbone, reprojected into the image as received."""
    return {f'plane_{view.name}/backbone': strip(distort(view, project(view.P, points)), THIN, FOUND)}


def drawn_tip(view: View, tip: np.ndarray, covariance: np.ndarray) -> Scene:
    """A ring around the tip (3,) in the image as received and, where its (3, 3) covariance is known, its ellipse."""
    shape = Shape(tip[None], np.zeros(1), np.where(np.trace(covariance) > UNKNOWN, np.nan, covariance)[None],
                  np.zeros((1, 2)))
    turn = np.linspace(0.0, 2 * np.pi, 49)
    ring = distort(view, project(view.P, tip[None])) + RING_PX * np.c_[np.cos(turn), np.sin(turn)]
    return {f'plane_{view.name}/tip': rr.LineStrips2D([ring, *filter(lambda curve: curve is not None,
                                                                     [tip_ellipse(view, shape)])], radii=THIN,
                                                      colors=rgb(TIP))}


def nothing() -> Scene:
    """Takes away what was found before: nothing stale stays."""
    return {path: rr.Clear(recursive=True)
            for path in ('device', 'tip', 'plane_a/backbone', 'plane_a/tip', 'plane_b/backbone', 'plane_b/tip')}


def close_up(points: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """(M, 3) mm from `tip` (3,) m, of the last CLOSE_UP of an (N, 3) curve, or of all of it where it is shorter."""
    s = even_steps(min(CLOSE_UP, max(arc_length(points)[-1], 1e-9)), CLOSE_UP / 10)
    return 1e3 * (at_arc_length(points[::-1], s)[::-1] - tip)


def strip(points: np.ndarray, radius, colour: str):
    """A line through (N, 2) px or (N, 3) points."""
    kind = rr.LineStrips2D if points.shape[1] == 2 else rr.LineStrips3D
    return kind([points], radii=radius, colors=rgb(colour))


def rgb(colour: str) -> list[int]:
    """Of #rrggbb."""
    return list(bytes.fromhex(colour[1:]))


# ---- over time


def values(**series: float) -> Scene:
    """Numbers of now by entity path, `/` written as `__`; those that are not known are left out."""
    return {name.replace('__', '/'): rr.Scalars(value) for name, value in series.items() if np.isfinite(value)}


def counts(outcomes: dict[str, int]) -> Scene:
    """How many pairs came to what, by name of the outcome."""
    return {f'pairs/{name}': rr.Scalars(count) for name, count in outcomes.items()}


def words(text: str, good: bool) -> Scene:
    """What became of the pairs from now on."""
    return {'log': rr.TextLog(text, level='INFO' if good else 'WARN', color=rgb(GOOD if good else REJECTED))}


def styles() -> Scene:
    """Names and colours of all lines; they don't change with time."""
    scene = {path: rr.SeriesPoints(names=name, colors=rgb(colour), marker_sizes=2.5)
                   if single else rr.SeriesLines(names=name, colors=rgb(colour), widths=1.5)
             for path, (name, colour, single) in SERIES.items()}
    refused = [outcome.value for outcome in Outcome if outcome is not Outcome.OK]
    colours = {Outcome.OK.value: GOOD} | {name: OTHERS[k % len(OTHERS)] for k, name in enumerate(refused)}
    return scene | {f'pairs/{name}': rr.SeriesLines(names=name.replace('_', ' '), colors=rgb(colour), widths=1.5)
                    for name, colour in colours.items()}


# ---- the page


def layout(roots: Sequence[str], latency: bool = True) -> rrb.Blueprint:
    """Where everything is on the page, a tab for each node; `roots` are their entity paths. Without `latency` there is
    no room for it."""
    nodes = [_of_node(root, latency) for root in roots]
    return rrb.Blueprint(nodes[0] if len(nodes) == 1 else rrb.Tabs(*nodes), rrb.TimePanel(state='collapsed'),
                         rrb.BlueprintPanel(state='collapsed'),
                         rrb.SelectionPanel(state='collapsed'), auto_views=False, auto_layout=False)


def _of_node(root: str, latency: bool) -> rrb.Vertical:
    bare = rrb.archetypes.LineGrid3D(visible=False)
    planes = [rrb.Spatial2DView(origin=f'{root}/plane_{plane}', name=f'plane {plane.upper()}') for plane in 'ab']
    space = [
        rrb.Spatial3DView(origin=root, contents=[f'+ {root}/**', f'- {root}/tip/**'], name='sources, detectors, device',
                          line_grid=bare),
        rrb.Spatial3DView(origin=root, contents=[f'+ {root}/device/**', f'+ {root}/truth'],
                          name='device (green: truth)', line_grid=bare),
        rrb.Spatial3DView(origin=f'{root}/tip', name=f'tip, {CONFIDENCE:.0%} ellipsoid, mm', line_grid=bare)]
    axes = {'confidence': rrb.ScalarAxis(range=(-0.05, 1.05))}
    plots = [rrb.TimeSeriesView(origin=f'{root}/{what}', name=name, plot_legend=rrb.PlotLegend(
        rrb.Corner2D.LeftBottom if what == 'confidence' else rrb.Corner2D.LeftTop),
                                axis_y=axes.get(what))
             for what, name in CURVES.items() if latency or what != 'milliseconds']
    return rrb.Vertical(rrb.Horizontal(rrb.Vertical(*planes), rrb.Vertical(*space), rrb.Vertical(*plots),
                                       column_shares=[4, 4, 4]),
                        rrb.TextLogView(origin=f'{root}/log', name='outcomes'), row_shares=[6, 1], name=root)
