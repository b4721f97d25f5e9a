"""Families of seeded scenes with known truth, by name: what the benches report on."""

from __future__ import annotations

from collections.abc import Callable

from ..sim.scenes import Scene, protocol_p, xray_scene

FAMILIES: dict[str, tuple[str, Callable[[int], Scene]]] = {
    'p': ('protocol P of the seed, drawn by VTK', lambda seed: protocol_p(seed)),
    'p_xray': ('protocol P, drawn by the X-ray renderer', lambda seed: protocol_p(seed, 'xray')),
    'anatomy': ('X-ray over anatomy, 0.3 mm/px', lambda seed: xray_scene(seed)),
}
