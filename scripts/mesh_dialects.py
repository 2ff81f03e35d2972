"""Small mesh files in the dialects that programs write, and files without a usable surface, as bytes.

Most hold one sheet: 3 x 3 nodes, 4 x 3 cm, as eight triangles or four quadrilaterals. `SURFACES` has the
content of a file and what must be read of it, by name; `REFUSED` the content and words of the refusal.
"""

import struct
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 0.04, 0.03
POINTS = np.array([[WIDTH / 2 * i, HEIGHT / 2 * j, 0.0] for j in range(3) for i in range(3)])
QUADS = [[a, a + 1, a + 4, a + 3] for a in (0, 1, 3, 4)]
TRIANGLES = [t for a, b, c, d in QUADS for t in ([a, b, c], [a, c, d])]
# A polygon that is not convex: a fan from its first corner would cover more than its area.
ANGLE = np.array([[0.02, 0.02, 0], [0.02, 0.04, 0], [0, 0.04, 0], [0, 0, 0], [0.04, 0, 0], [0.04, 0.02, 0]])


@dataclass(frozen=True)
class Expected:
    """What must be read of a file, and how."""

    nodes: int = 9
    faces: int = 8
    area: float = WIDTH * HEIGHT
    options: tuple[tuple[str, object], ...] = ()


SHEET = Expected()
MIXED = [*QUADS[:2], *TRIANGLES[4:]]


def numbers(rows, form="{:.17g}"):
    """Rows of numbers as lines."""
    return "".join(" ".join(form.format(value) for value in row) + "\n" for row in rows)


def obj(faces=TRIANGLES, corner="{}", tail="", points=POINTS, head=""):
    lines = [f"v {x!r} {y!r} {z!r}{tail}\n" for x, y, z in points.tolist()]
    polygons = ["f " + " ".join(corner.format(i + 1) for i in face) + "\n" for face in faces]
    return (head + "".join(lines) + "".join(polygons)).encode()


def ply_header(
    kind, faces, vertex="", face="", element="", corners="uchar int vertex_indices", axis="double"
):
    n = len(POINTS)
    axes = "".join(f"property {axis} {name}\n" for name in "xyz")
    return (
        f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex {n}\n{axes}{vertex}"
        f"element face {len(faces)}\nproperty list {corners}\n{face}{element}end_header\n"
    )


def ply(faces=TRIANGLES, vertex="", face="", element="", tail="", after="", rows="", **header):
    lines = "".join(" ".join(map(repr, p)) + tail + "\n" for p in POINTS.tolist())
    polygons = "".join(f"{len(f)} " + " ".join(map(str, f)) + after + "\n" for f in faces)
    return (ply_header("ascii", faces, vertex, face, element, **header) + lines + polygons + rows).encode()


def binary_ply(order, faces=TRIANGLES, count="B", corner="i", names="uchar int", texture=False, edges=False):
    kind = "binary_little_endian" if order == "<" else "binary_big_endian"
    face = "property list uchar float texcoord\n" if texture else ""
    edge = "element edge 2\nproperty int vertex1\nproperty int vertex2\n" if edges else ""
    head = ply_header(kind, faces, face=face, element=edge, corners=f"{names} vertex_index", axis="float")
    body = np.asarray(POINTS, order + "f4").tobytes()
    for f in faces:
        body += struct.pack(f"{order}{count}{len(f)}{corner}", len(f), *f)
        body += struct.pack(f"{order}B{2 * len(f)}f", 2 * len(f), *[0.5] * 2 * len(f)) if texture else b""
    return head.encode() + body + (struct.pack(f"{order}4i", 0, 1, 1, 2) if edges else b"")


def off(head="OFF\n9 8 0\n", faces=TRIANGLES, tail="", after="", points=POINTS):
    polygons = "".join(f"{len(f)} " + " ".join(map(str, f)) + after + "\n" for f in faces)
    return (head + "".join(" ".join(map(repr, p)) + tail + "\n" for p in points.tolist()) + polygons).encode()


def stl(noise=0.0, words=str, parts=1, scale=1.0):
    rng = np.random.default_rng(1)
    text = ""
    for part in np.split(np.array(TRIANGLES), parts):
        text += "solid sheet\n"
        for corners in POINTS[part] * scale:
            text += "facet normal 0 0 1\nouter loop\n"
            text += "".join(
                f"vertex {x:.12e} {y:.12e} {z:.12e}\n"
                for x, y, z in corners + noise * rng.uniform(-1, 1, (3, 3))
            )
            text += "endloop\nendfacet\n"
        text += "endsolid sheet\n"
    return words(text).encode()


def binary_stl(header=b"solid but binary", attribute=b"\0\0"):
    body = b"".join(np.array([[0, 0, 1], *POINTS[t]], "<f4").tobytes() + attribute for t in TRIANGLES)
    return header.ljust(80, b" ") + struct.pack("<I", len(TRIANGLES)) + body


def vtk(cells="", head="DATASET POLYDATA", version="3.0", after="", points=POINTS):
    return (
        f"# vtk DataFile Version {version}\na sheet\nASCII\n{head}\n"
        f"POINTS {len(points)} double\n{numbers(points)}{cells}{after}"
    ).encode()


def vtk_cells(name, faces):
    rows = [[len(f), *f] for f in faces]
    return f"{name} {len(rows)} {sum(map(len, rows))}\n{numbers(rows, '{}')}"


def vtk_offsets(name, faces):
    starts = np.cumsum([0, *map(len, faces)])
    return (
        f"{name} {len(starts)} {starts[-1]}\nOFFSETS vtktypeint64\n{numbers([starts], '{}')}"
        f"CONNECTIVITY vtktypeint64\n{numbers([np.concatenate(faces)], '{}')}"
    )


def binary_vtk(faces=TRIANGLES, offsets=False, data=b""):
    version = b"5.1" if offsets else b"3.0"
    head = b"# vtk DataFile Version " + version + b"\na sheet\nBINARY\nDATASET POLYDATA\nPOINTS 9 float\n"
    body = head + np.asarray(POINTS, ">f4").tobytes() + b"\n"
    if offsets:
        starts, corners = np.cumsum([0, *map(len, faces)]), np.concatenate(faces)
        body += b"METADATA\nINFORMATION 0\n\n"
        body += f"POLYGONS {len(starts)} {len(corners)}\nOFFSETS vtktypeint64\n".encode()
        body += np.asarray(starts, ">i8").tobytes() + b"\nCONNECTIVITY vtktypeint64\n"
        return body + np.asarray(corners, ">i8").tobytes() + b"\n" + data
    rows = np.concatenate([[len(f), *f] for f in faces])
    return (
        body
        + f"POLYGONS {len(faces)} {len(rows)}\n".encode()
        + np.asarray(rows, ">i4").tobytes()
        + b"\n"
        + data
    )


def vtu(faces=TRIANGLES, kind=5, points=POINTS, data=""):
    ends = np.cumsum([len(f) for f in faces])

    def array(name, kind, rows, more=""):
        head = f'<DataArray type="{kind}" Name="{name}" format="ascii"{more}>'
        return f"{head}\n{numbers(rows, '{}')}</DataArray>\n"

    return (
        '<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">\n'
        f'<UnstructuredGrid>\n<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(faces)}">\n<Points>\n'
        + array("Points", "Float64", points.tolist(), ' NumberOfComponents="3"')
        + f"</Points>\n{data}<Cells>\n"
        + array("connectivity", "Int64", faces)
        + array("offsets", "Int64", [ends.tolist()])
        + array("types", "UInt8", [[kind] * len(faces)])
        + "</Cells>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n"
    ).encode()


UNSTRUCTURED = vtk_cells("CELLS", TRIANGLES) + "CELL_TYPES 8\n" + "5\n" * 8


def gmsh2(extra_nodes="", extra_cells="", n=9, cells=8, faces=TRIANGLES):
    nodes = "".join(f"{i} {' '.join(map(repr, p))}\n" for i, p in enumerate(POINTS.tolist(), 1))
    kind = 3 if len(faces[0]) == 4 else 2
    rows = "".join(f"{k} {kind} 2 0 1 {' '.join(str(i + 1) for i in f)}\n" for k, f in enumerate(faces, 1))
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{n}\n{nodes}{extra_nodes}$EndNodes\n"
        f"$Elements\n{cells}\n{rows}{extra_cells}$EndElements\n"
    ).encode()


def gmsh4(centre=False, volume=False):
    """A file of version 4.1 with `Mesh.SaveAll`: points and curves as well, and an arc's centre."""
    blocks = [(0, 1, [1]), (1, 1, [2, 3]), (2, 1, [4, 5, 6, 7, 8, 9])]
    where = {tag: POINTS[tag - 1] for tag in range(1, 10)}
    if centre:
        blocks.insert(1, (0, 5, [10]))
        where[10] = np.array([0.1, 0.1, 0.0])
    nodes = "".join(
        f"{dim} {entity} 0 {len(tags)}\n{numbers([[tag] for tag in tags], '{}')}"
        f"{numbers([where[tag] for tag in tags])}"
        for dim, entity, tags in blocks
    )
    cells = [(0, 1, 15, [[1]]), (1, 1, 1, [[1, 2], [2, 3]])]
    cells += [(0, 5, 15, [[10]])] if centre else []
    cells += [(2, 1, 2, [[i + 1 for i in t] for t in TRIANGLES])]
    cells += [(3, 1, 4, [[1, 2, 4, 5]])] if volume else []
    tag, text = 0, ""
    for dim, entity, kind, rows in cells:
        text += f"{dim} {entity} {kind} {len(rows)}\n"
        for row in rows:
            tag += 1
            text += f"{tag} {' '.join(map(str, row))}\n"
    return (
        f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n{len(blocks)} {len(where)} 1 {len(where)}\n"
        f"{nodes}$EndNodes\n$Elements\n{len(cells)} {tag} 1 {tag}\n{text}$EndElements\n"
    ).encode()


SEAM = "vt 0 0\nvt 1 1\nvn 0 0 1\n"
EXTRA = np.vstack([POINTS, [[0.5, 0.5, 0.5]]])
BROKEN_LINE = obj().replace(b"f 1 2 5\n", b"f 1 2 \\\n5\n")
BACKWARDS = obj(faces=[]) + "".join(f"f {a - 9} {b - 9} {c - 9}\n" for a, b, c in TRIANGLES).encode()
SCALARS = "SCALARS h double 1\nLOOKUP_TABLE default\n" + "1e-3\n" * 9
STRIPS = [[3, 0, 4, 1, 5, 2], [6, 3, 7, 4, 8, 5]]
EDGE = "element edge 1\nproperty int vertex1\nproperty int vertex2\n"
MANY = ply().replace(b"element vertex 9", b"element vertex 999999999999")
BOTH_DATA = "CELL_DATA 6\nSCALARS c int\nLOOKUP_TABLE default\n1 2 3 4 5 6\nPOINT_DATA 9\n" + SCALARS
TEXTURE = " 6 0 0 1 0 1 1"
ONE_ANGLE = Expected(nodes=6, faces=4, area=12e-4)
NGON = [[0, 1, 2, 3, 4, 5]]
# Not convex at the second corner: only the longer diagonal, from there, lies inside.
DART = np.array([[0, 0, 0], [0.1, 0.01, 0], [0.2, 0, 0], [0.1, 0.9, 0]])

SURFACES: dict[str, tuple[bytes, Expected]] = {
    "plain.obj": (obj(), SHEET),
    "texture.obj": (obj(corner="{}/1", head=SEAM), SHEET),
    "seam.obj": (obj(corner="{}/1", head=SEAM).replace(b"f 1/1 5/1 4/1", b"f 1/2 5/2 4/2"), SHEET),
    "normals.obj": (obj(corner="{}//1", head=SEAM), SHEET),
    "both.obj": (obj(corner="{}/2/1", head=SEAM), SHEET),
    "colours.obj": (obj(tail=" 0.5 0.25 1"), SHEET),
    "weights.obj": (obj(tail=" 1.0"), SHEET),
    "negative.obj": (BACKWARDS, SHEET),
    "continued.obj": (BROKEN_LINE, SHEET),
    "comments.obj": (obj(tail=" # a node \\").replace(b"f 1 2 5", b"f 1 2 5 # first"), SHEET),
    "mark.obj": (b"\xef\xbb\xbf" + obj(), SHEET),
    "windows.obj": (BROKEN_LINE.replace(b"\n", b"\r\n"), SHEET),
    "groups.obj": (obj(head="mtllib none.mtl\no a\ng b\ns off\nusemtl c\nl 1 2\np 1\n"), SHEET),
    "quads.obj": (obj(QUADS), SHEET),
    "mixed.obj": (obj(MIXED), SHEET),
    "angle.obj": (obj(NGON, points=ANGLE), ONE_ANGLE),
    "dart.obj": (obj([[0, 1, 2, 3]], points=DART), Expected(4, 2, 0.5 * 0.2 * (0.9 - 0.01))),
    "unused.obj": (obj(points=EXTRA), SHEET),
    "millimetres.obj": (obj(points=1e3 * POINTS), Expected(options=(("unit", "mm"),))),
    "plain.ply": (ply(), SHEET),
    "uint8.ply": (ply(corners="uint8 int32 vertex_indices"), SHEET),
    "index.ply": (ply(corners="int uint vertex_index"), SHEET),
    "colours.ply": (
        ply(vertex="".join(f"property uchar {c}\n" for c in ("red", "green", "blue")), tail=" 1 2 3"),
        SHEET,
    ),
    "texture.ply": (ply(face="property list uchar float texcoord\n", after=TEXTURE), SHEET),
    "edges.ply": (
        ply(element="element edge 1\nproperty int vertex1\nproperty int vertex2\n", rows="0 1\n"),
        SHEET,
    ),
    "mixed.ply": (ply(MIXED, face="property uchar flags\n", after=" 7"), SHEET),
    "little.ply": (binary_ply("<"), SHEET),
    "big.ply": (binary_ply(">"), SHEET),
    "int32.ply": (binary_ply("<", count="i", corner="I", names="int32 uint32"), SHEET),
    "mixed_little.ply": (binary_ply("<", MIXED), SHEET),
    "texture_big.ply": (binary_ply(">", MIXED, texture=True, edges=True), SHEET),
    "edges_little.ply": (binary_ply("<", edges=True, texture=True), SHEET),
    "strips.ply": (
        ply(
            [],
            element="element tristrips 1\nproperty list int int vertex_indices\n",
            rows="13 3 0 4 1 5 2 -1 6 3 7 4 8 5\n",
        ),
        SHEET,
    ),
    "plain.off": (off(), SHEET),
    "one_line.off": (off("OFF 9 8 0\n"), SHEET),
    "glued.off": (off("OFF9 8 0\n"), SHEET),
    "comments.off": (off("# a sheet\nOFF # here\n\n9 8 0\n"), SHEET),
    "coff.off": (off("COFF\n9 8 0\n", tail=" 255 0 0 255"), SHEET),
    "faces.off": (off(after=" 3 0.1 0.2 0.3"), SHEET),
    "nameless.off": (off("STCNOFF 9 4 0\n", QUADS, tail=" 0 0 1 1 1 1 1 0 0"), SHEET),
    "angle.off": (off("OFF\n6 1 0\n", NGON, points=ANGLE), ONE_ANGLE),
    "plain.stl": (stl(), SHEET),
    "capitals.stl": (stl(words=str.upper), SHEET),
    "apart.stl": (stl(noise=1e-8), SHEET),
    "unit_apart.stl": (stl(noise=1e-8, scale=25.0), Expected(area=625 * WIDTH * HEIGHT)),
    "latin.stl": (stl().replace(b"sheet", b"sh\xe9\xe9t"), SHEET),
    "two.stl": (stl(parts=2), SHEET),
    "binary.stl": (binary_stl(), SHEET),
    "coloured.stl": (binary_stl(b"COLOR=abcd", b"\x12\x34"), SHEET),
    "polydata.vtk": (vtk(vtk_cells("POLYGONS", TRIANGLES)), SHEET),
    "quads.vtk": (vtk(vtk_cells("POLYGONS", QUADS)), SHEET),
    "cells.vtk": (
        vtk(
            vtk_cells("VERTICES", [[0]]) + vtk_cells("LINES", [[0, 1, 2]]) + vtk_cells("POLYGONS", MIXED),
            after=BOTH_DATA,
        ),
        SHEET,
    ),
    "strips.vtk": (vtk(vtk_cells("TRIANGLE_STRIPS", STRIPS)), SHEET),
    "offsets.vtk": (vtk(vtk_offsets("POLYGONS", MIXED), version="5.1"), SHEET),
    "binary.vtk": (binary_vtk(), SHEET),
    "binary_offsets.vtk": (binary_vtk(MIXED, offsets=True), SHEET),
    "binary_data.vtk": (
        binary_vtk(
            data=b"POINT_DATA 9\nFIELD FieldData 1\nh 1 9 double\n"
            + np.full(9, 1e-3).astype(">f8").tobytes()
            + b"\n"
        ),
        SHEET,
    ),
    "unstructured.vtk": (vtk(UNSTRUCTURED, "DATASET UNSTRUCTURED_GRID"), SHEET),
    "structured.vtk": (vtk(head="DATASET STRUCTURED_GRID\nDIMENSIONS 3 3 1"), SHEET),
    "plain.vtu": (vtu(), SHEET),
    "quads.vtu": (vtu(QUADS, 9), SHEET),
    "unused.vtu": (vtu(points=EXTRA), SHEET),
    "angle.vtu": (vtu(NGON, 7, ANGLE), ONE_ANGLE),
    "plain.msh": (gmsh2(), SHEET),
    "quads.msh": (gmsh2(faces=QUADS, cells=4), SHEET),
    "arc.msh": (gmsh2("10 1 1 0\n", "9 15 2 0 1 10\n10 1 2 0 1 1 2\n", 10, 10), SHEET),
    "all.msh": (gmsh4(), SHEET),
    "arc_all.msh": (gmsh4(centre=True), SHEET),
}

FIN = np.vstack([POINTS, [[0.02, 0.015, 0.02]]])

REFUSED: dict[str, tuple[bytes, str]] = {
    "empty.obj": (b"", "has no points"),
    "points.obj": (obj(faces=[]), "has no triangles"),
    "word.obj": (obj().replace(b"v 0.02 ", b"v two ", 1), r"line 2, 'v two .*could not convert"),
    "zero.obj": (obj() + b"f 0 1 2\n", "line 18.*counted from 1"),
    "beyond.obj": (obj() + b"f 1 2 12\n", r"face with point 11, outside 0\.\.8"),
    "nan.obj": (obj().replace(b"v 0.02 ", b"v nan ", 1), "point 1, which is not finite"),
    "bow.obj": (obj([[0, 1, 3, 4]]), "face 0 with 4 corners crosses itself"),
    "star.obj": (obj([[0, 1, 3, 4, 2]]), "face 0 with 5 corners crosses itself"),
    "fin.obj": (obj([*TRIANGLES, [0, 4, 9]], points=FIN), r"edge \(0, 4\) belongs to 3 faces"),
    "twice.obj": (obj([*TRIANGLES, [4, 1, 0]]), r"faces \(0, 8\) have the same nodes"),
    "sliver.obj": (obj([*TRIANGLES, [0, 1, 2]]), "has no area"),
    "pieces.obj": (obj([TRIANGLES[0], [5, 8, 7]]), "2 separate pieces of 3, 3 nodes"),
    "empty.ply": (b"", "no header"),
    "short.ply": (binary_ply("<")[:-5], "a list of 3 values where there is room for 1"),
    "cut.ply": (ply()[:-9], "ends"),
    "type.ply": (ply(axis="quad"), "unknown type 'quad'"),
    "many.ply": (
        ply().replace(b"element vertex 9", b"element vertex 999999999999"),
        "ends before its 999999999999",
    ),
    "headless.off": (b"9 8 0\n", "does not begin with OFF"),
    "short.off": (off("OFF\n9 80 0\n"), "ends after 9 of 9 points and 8 of 80 faces"),
    "binary.off": (b"OFF BINARY\n\0\0\0\x09", "is binary"),
    "empty.stl": (b"", "no facets"),
    "short.stl": (binary_stl()[:-10], "no facets"),
    "word.stl": (stl().replace(b"vertex 2", b"vertex two", 1), "cannot read"),
    "grid.vtk": (vtk(head="DATASET POLYGON"), "POLYGON"),
    "short.vtk": (binary_vtk()[:-12], "ends before"),
    "solid.msh": (gmsh4(volume=True), "cells of type tetra; export the surface alone"),
    "curved.msh": (
        gmsh2(extra_cells="9 9 2 0 1 1 3 9 2 6 5\n", cells=9),
        "cells of type triangle6; export the surface",
    ),
    "junk.msh": (b"not a mesh", "cannot read"),
    "junk.vtu": (b"<VTKFile", "cannot read"),
    "junk.unheard": (b"not a mesh", "cannot read"),
}
