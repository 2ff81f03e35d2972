"""Plot a sheet in space: ray cast where Embree has a wheel, else sorted by depth."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize, SymLogNorm, to_rgb
from matplotlib.figure import Figure

from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.plot.camera import UP, VIEW, Camera, camera_for
from jaxcrumple.plot.figure import new_figure
from jaxcrumple.plot.light import LAMP, linear, srgb
from jaxcrumple.plot.normals import face_normals

CURVATURE_LABEL = "mean curvature $H$ [1/m]\n> 0: convex on the light side"
DIVERGING = "RdBu_r"  # red: convex as seen from the side of the face normals
# For values of which 0 means nothing there.
FROM_NOTHING = ListedColormap([(0.82, 0.82, 0.82), *colormaps["viridis"].colors], "from-nothing")  # type: ignore[attr-defined]
# The largest curvatures occur at single sharp hinges; colours span the values of this share of the nodes.
ROBUST = 0.98
# Colour of a sheet without values, and longer side of a picture in pixels.
PAPER, PIXELS = "#efe9dc", 820
# Walls appear within a ball around the sheet whose radius is ROUND times the largest distance of its nodes.
ROUND = 1.25
# Length bar: its length is at most this share of the width; lengths in mm to choose from, times powers of 10.
BAR, ROUND_LENGTHS = 0.25, (1, 2, 5)


class Walls(NamedTuple):
    """Hold the walls of a picture: their `shapes`, and the time `t` in s."""

    shapes: Sequence[AbstractShape] = ()
    t: float = 0.0


NO_WALLS = Walls()


def sheet_figure(
    mesh: Mesh,
    x: Float[np.ndarray, "nodes 3"],
    color: ScalarMappable | str,
    values: Float[np.ndarray, " ..."] | None = None,
    *,
    label: str = "",
    camera: Camera,
    walls: Walls,
    pixels: int,
    caption: str,
    axes: Axes | None = None,
) -> Figure:
    """Draw the sheet into `axes`, or into a new figure with a colour bar, and return the figure.

    `label`: of the colour bar; `caption`: text above the figure, such as size and tolerance of the run; other
    arguments as of `draw_into`.
    """
    if axes is not None:
        draw_into(axes, mesh, x, color, values, camera=camera, walls=walls, pixels=pixels)
        return axes.figure.figure
    figure = new_figure((7.2, 6.0), caption)
    axes = figure.add_subplot()
    draw_into(axes, mesh, x, color, values, camera=camera, walls=walls, pixels=pixels)
    if not isinstance(color, str):
        beyond: Any = "both" if color.get_clim()[0] < 0 else "max"
        figure.colorbar(color, ax=axes, label=label, shrink=0.65, extend=beyond)
    return figure


def draw_into(
    axes: Axes,
    mesh: Mesh,
    x: Float[np.ndarray, "nodes 3"],
    color: ScalarMappable | str,
    values: Float[np.ndarray, " ..."] | None = None,
    *,
    camera: Camera,
    walls: Walls = NO_WALLS,
    pixels: int = PIXELS,
) -> None:
    """Draw the sheet at positions `x` (n, 3) in m into axes in mm, which lose their frame, with a length bar.

    `color`: a colour, or a scale for `values` per node (n,) or face (f,). The back, opposite to the face
    normals, is darker and bluish. Where Embree has no wheel, triangles are sorted by depth, without shadows
    and walls.
    """
    if values is not None and values.shape not in ((mesh.n_nodes,), (len(mesh.faces),)):
        raise ValueError(f"color has shape {values.shape}; give one value per node or per face of the mesh")
    width, height = 1e3 * camera.width, 1e3 * camera.height
    if importlib.util.find_spec("embreex") is None:
        _draw_sorted(axes, mesh, x, color, values, camera)
    else:
        picture = _ray_cast(mesh, x, color, values, camera, walls, pixels)
        extent = (-0.5 * width, 0.5 * width, -0.5 * height, 0.5 * height)
        axes.imshow(picture, extent=extent, interpolation="antialiased")
    axes.set(xlim=(-0.5 * width, 0.5 * width), ylim=(-0.5 * height, 0.5 * height), aspect="equal")
    axes.set_axis_off()
    _draw_bar(axes, width, height)


def camera_of(
    x: Float[np.ndarray, "nodes 3"],
    walls: Walls = NO_WALLS,
    view: Sequence[float] = VIEW,
    up: Sequence[float] = UP,
) -> Camera:
    """Return the camera that sees the sheet at `x` (n, 3) in m, and the walls around it."""
    if not walls.shapes:
        return camera_for(x, view, up)
    from jaxcrumple.plot.wall_layers import surface_points

    points = surface_points(walls.shapes, walls.t, *_ball(x))
    return camera_for(np.concatenate([x, points]), view, up)


def color_scale(
    *frames: Float[np.ndarray, " ..."], signed: bool, decades: float | None = None, least: float = 0.0
) -> ScalarMappable:
    """Return a colour scale that spans the values of one frame, or of the frame with the largest ones.

    It is symmetric about 0 if `signed`, else from low to high; outliers of each frame saturate. With
    `decades`, it begins at 0 and is logarithmic over so many decades below its end. Its end is at least
    `least`, so that rounding errors get no colours.
    """
    colors: Colormap | str
    finite = [values[np.isfinite(values)] for values in frames]
    norm = Normalize()
    if decades is None:
        ends = [np.quantile(np.abs(values) if signed else values, ROBUST) for values in finite if len(values)]
    else:
        ends = [values.max(initial=0.0) for values in finite]
    high = max([least, *map(float, ends)])
    if decades is not None:
        high = high or 1.0
        norm, colors = SymLogNorm(high / 10.0**decades, vmin=0.0, vmax=high), FROM_NOTHING
    elif signed:
        norm, colors = Normalize(-(high or 1.0), high or 1.0), DIVERGING
    else:
        low = min((float(np.quantile(values, 1 - ROBUST)) for values in finite if len(values)), default=0.0)
        norm, colors = Normalize(low, high if high > low else low + 1.0), "viridis"
    scale = ScalarMappable(norm, colors)
    scale.set_array(np.concatenate([values.ravel() for values in frames]))
    return scale


def _ball(x: Float[np.ndarray, "nodes 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """Return centre and radius in m of the ball in which walls are drawn."""
    center = 0.5 * (x.min(axis=0) + x.max(axis=0))
    return center, ROUND * float(np.linalg.norm(x - center, axis=1).max())


def _ray_cast(
    mesh: Mesh,
    x: Float[np.ndarray, "nodes 3"],
    color: ScalarMappable | str,
    values: Float[np.ndarray, " ..."] | None,
    camera: Camera,
    walls: Walls,
    pixels: int,
) -> Float[np.ndarray, "rows columns 4"]:
    """Return the picture as sRGB and opacity."""
    from jaxcrumple.plot.raycast import Caster, Hits, cast
    from jaxcrumple.plot.wall_layers import wall_layers

    def paint(hits: Hits) -> Float[np.ndarray, "hits 3"]:
        if isinstance(color, str):
            return np.broadcast_to(linear(np.array(to_rgb(color))), (len(hits.rays), 3))
        assert values is not None
        if len(values) == mesh.n_nodes:
            seen = np.einsum("hc,hc->h", hits.shares, values[mesh.faces[hits.faces]])
        else:
            seen = values[hits.faces]
        return linear(color.to_rgba(seen)[:, :3])

    layers = []
    if walls.shapes:
        shape = camera.shape(pixels)
        origins = camera.center + camera.origins(shape, np.full((*shape, 2), 0.5))
        layers = wall_layers(walls.shapes, walls.t, *_ball(x), origins, -camera.axes[2])
    return srgb(cast(Caster(mesh.faces, x, camera), paint, pixels, layers=layers))


def _draw_sorted(
    axes: Axes,
    mesh: Mesh,
    x: Float[np.ndarray, "nodes 3"],
    color: ScalarMappable | str,
    values: Float[np.ndarray, " ..."] | None,
    camera: Camera,
) -> None:
    """Draw the triangles from the farthest to the nearest, shaded by the angle between normal and lamp."""
    seen = (x - camera.center) @ camera.axes.T
    corners = seen[mesh.faces]
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    if isinstance(color, str):
        colors = np.tile(to_rgb(color), (len(mesh.faces), 1))
    else:
        assert values is not None
        on_faces = values[mesh.faces].mean(axis=1) if len(values) == mesh.n_nodes else values
        colors = color.to_rgba(on_faces)[:, :3]
    normal = face_normals(mesh.faces, seen)
    light = 0.45 + 0.55 * np.abs(normal @ np.array(LAMP)) / np.linalg.norm(LAMP)
    shaded = (colors * light[:, None])[order]
    triangles = 1e3 * corners[order, :, :2]
    axes.add_collection(PolyCollection(triangles, facecolors=shaded, edgecolors=shaded, linewidths=0.2))


def _draw_bar(axes: Axes, width: float, height: float) -> None:
    """Draw a bar of a round length into the lower left corner; `width`, `height` of the axes in mm."""
    longest = BAR * width
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(n * power for n in ROUND_LENGTHS if n * power <= longest)
    left, low = -0.48 * width, -0.5 * height
    axes.plot(
        [left, left + length], [low, low], color="black", linewidth=2.0, solid_capstyle="butt", clip_on=False
    )
    text = f"{length / 10:g} cm" if length >= 10 else f"{length:g} mm"
    axes.annotate(
        text,
        (left + 0.5 * length, low),
        (0, -3),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=9,
    )
