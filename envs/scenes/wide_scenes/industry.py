"""Families of wide scenes: factories, workshops, laboratories. All lengths in m."""

import math

from roboarm_nmp.envs.scenes.wide_scenes.site import DOWN, FORWARD, INTO, Site, turned


def conveyor(site: Site) -> None:
    """A belt that runs past the arm, with parcels on it, rails, and a scanner's arch over it."""
    width, top = site.between(0.35, 0.7), site.between(0.5, 0.95)
    length = site.between(1.6, 2.6)
    site.box((width / 2, 0, top - 0.05), (width, length, 0.1))
    for y in (-0.35, 0.35):
        site.box((width / 2, y * length, (top - 0.1) / 2), (width - 0.1, 0.08, top - 0.1))
    rail = top + site.between(0.05, 0.15)
    for x in (-0.02, width + 0.02):
        if site.chance(0.7):
            site.rod((x, -length / 2, rail), (x, length / 2, rail), site.between(0.01, 0.02))
    clear, post = site.between(0.3, 0.55), site.between(0.04, 0.1)
    for y in site.rng.uniform(-0.5, 0.5, site.count(1, 2)):
        for x in (-post, width + post):
            site.box((x, y, (top + clear) / 2), (post, post, top + clear))
        deep = site.between(0.08, 0.4)
        site.box((width / 2, y, top + clear + 0.04), (width + 3 * post, deep, 0.08))
        site.place((width / 2, y, top + clear / 2), (width * 0.8, deep + 0.1, clear * 0.6))
    if site.chance(0.5):  # an arm that pushes parcels aside
        turn, y = site.between(-1.0, 1.0), site.between(-0.5, 0.5)
        site.box((width / 2, y, top + 0.08), (width * 0.9, 0.03, 0.1), turn)
    for x, y in site.spots(site.count(2, 6), (0.1, width - 0.1), (-0.7, 0.7), 0.25):
        if site.chance(0.3):
            site.thing((x, y, top), 0.2)
            continue
        size = [site.between(0.08, 0.3), site.between(0.08, 0.25), site.between(0.05, 0.25)]
        if site.chance(0.7):
            site.box((x, y, top + size[2] / 2), size, site.between(-1.5, 1.5))
        else:
            site.lump((x, y, top + size[2] / 2), size)
    site.place((width / 2, 0, top + 0.1), (width * 0.8, 1.2, 0.15), DOWN)
    site.place((width + 0.1, 0, top + 0.1), (0.1, 1.0, 0.15), INTO)


def laboratory(site: Site) -> None:
    """A bench with a fume hood, its sash half down, a centrifuge, tube racks, a microscope."""
    depth, width, top = site.between(0.55, 0.75), site.between(1.2, 1.8), site.between(0.8, 0.95)
    site.box((depth / 2, 0, top - 0.03), (depth, width, 0.06))
    site.box((depth / 2 + 0.05, 0, (top - 0.06) / 2), (depth - 0.1, width - 0.2, top - 0.06))
    inner = site.between(-0.1, 0.15)
    hood = site.between(0.5, 0.8)
    site.case((0.03, inner, top), (depth, width / 2, top + hood), 0.02, "fb")
    sash = hood * site.between(0.25, 0.6)
    site.box(
        (0.02, (inner + width / 2) / 2, top + hood - sash / 2), (0.015, width / 2 - inner, sash)
    )
    middle = (inner + width / 2) / 2
    site.place((depth / 2, middle, top + 0.14), (depth * 0.6, width / 2 - inner - 0.15, 0.2))
    site.things(
        site.count(1, 3), (0.12, depth - 0.1), (inner + 0.1, width / 2 - 0.1), top, hood - sash
    )
    x, y, radius = (
        site.between(0.2, depth - 0.2),
        site.between(-0.35, -0.2),
        site.between(0.12, 0.18),
    )
    wall, staves = site.between(0.15, 0.28), 10
    for i in range(staves):
        angle = 2 * math.pi * i / staves
        chord = 2 * (radius + 0.03) * math.tan(math.pi / staves)
        centre = (x + radius * math.cos(angle), y + radius * math.sin(angle), top + wall / 2)
        site.box(centre, (0.03, chord, wall), angle)
    lid, edge = site.between(1.2, 2.0), (x + radius, top + wall)
    along = (math.cos(math.pi - lid) * radius, math.sin(math.pi - lid) * radius)
    normal = turned(0.0, lid - math.pi) @ (0.0, 0.0, 0.015)
    hinge = (edge[0] - along[0] * -1, y, edge[1] + along[1])
    site.rod(hinge - normal, hinge + normal, radius)
    site.place((x, y, top + wall - 0.03), (radius, radius, 0.12), DOWN)
    x, y = site.between(0.1, depth - 0.2), -width / 2 + site.between(0.12, 0.3)
    for level in (0.005, 0.06):
        site.box((x, y, top + level), (0.09, 0.2, 0.01))
    for u in (-0.03, 0.03):
        for v in (-0.08, -0.04, 0.0, 0.04, 0.08):
            if site.chance(0.45):
                tall = site.between(0.1, 0.15)
                site.can((x + u, y + v, top + 0.01), 0.008, tall)
                site.grasp_from_above((x + u, y + v, top), 0.016, tall, math.pi * site.count(0, 1))
    if site.chance(0.7):  # a microscope
        x, y = depth - 0.2, site.between(-0.1, 0.0)
        site.box((x, y, top + 0.02), (0.25, 0.18, 0.04))
        site.box((x + 0.09, y, top + 0.2), (0.06, 0.08, 0.36))
        site.rod((x + 0.09, y, top + 0.36), (x - 0.12, y, top + 0.5), 0.03)
        site.rod((x - 0.04, y, top + 0.18), (x - 0.04, y, top + 0.38), 0.025)
        site.box((x - 0.03, y, top + 0.12), (0.12, 0.14, 0.015))
        site.place((x - 0.05, y, top + 0.15), (0.05, 0.08, 0.02), FORWARD)


def machine_tool(site: Site) -> None:
    """A milling machine: an enclosure with a sliding door, a spindle above a vice with a part."""
    width, depth = site.between(0.7, 1.2), site.between(0.55, 0.8)
    low, high = site.between(0.6, 0.8), site.between(1.5, 1.7)
    site.case((0, -width / 2, low), (depth, width / 2, high), 0.03, "f")
    site.box((depth / 2, 0, low / 2), (depth, width, low))
    opened = site.between(0.4, 1.0) * width
    if opened < 0.95 * width:
        site.box((0.015, opened / 2, (low + high) / 2), (0.03, width - opened, high - low))
    bed = low + site.between(0.08, 0.2)
    x, y = depth * site.between(0.45, 0.6), -(width - opened) / 2 + site.between(-0.1, 0.1)
    site.box((x, y, bed - 0.03), (0.3, site.between(0.35, 0.5), 0.06))
    gap, jaw = site.between(0.03, 0.12), site.between(0.05, 0.09)
    site.box((x, y, bed + 0.02), (0.14, gap + 2 * jaw, 0.04))
    for side in (-1, 1):
        site.box((x, y + side * (gap + jaw) / 2, bed + 0.06), (0.14, jaw, 0.06))
    part = site.between(0.03, 0.14)
    if site.chance(0.75):
        site.box((x, y, bed + 0.04 + part / 2), (site.between(0.05, 0.15), gap, part))
        if gap < 0.055:
            site.grasp_from_above((x, y, bed + 0.04), gap, part, math.pi / 2)
    above = bed + part + site.between(0.16, 0.4)
    tool, radius = site.between(0.05, 0.12), site.between(0.004, 0.02)
    site.can((x, y, above - tool), radius, tool)
    site.can((x, y, above), site.between(0.03, 0.05), 0.08)
    site.can((x, y, above + 0.08), site.between(0.06, 0.1), 0.14)
    if above + 0.2 < high - 0.05:
        site.box(((x + depth) / 2, y, above + 0.25), (depth - x + 0.15, 0.2, 0.2))
    for _ in range(site.count(1, 3)):  # coolant hoses
        end = (x - site.between(-0.05, 0.08), y + site.between(-0.09, 0.09), above - tool / 2)
        bend = (x + 0.02, y + site.between(-0.2, 0.2), above + 0.02)
        site.rods([(x + 0.1, y, above + 0.2), bend, end], 0.008)
    site.place((x, y, (bed + 0.1 + above - tool) / 2), (0.3, 0.25, above - tool - bed - 0.05))
    site.place((x - 0.05, y, bed + 0.16), (0.25, 0.4, 0.1), INTO)
    if site.chance(0.6):  # the control panel on its arm
        side = width / 2 + site.between(0.0, 0.2)
        x = -site.between(0.1, 0.3)
        site.rods([(0.1, side, high), (x, side, high), (x, side, high - 0.3)], 0.03)
        site.box((x, side, high - 0.45), (0.06, 0.35, 0.3), site.between(-0.6, 0.6))


def pipes(site: Site) -> None:
    """Pipes that cross each other in three directions, with flanges, valves and a tank."""
    back = site.between(0.4, 0.7)
    wide = site.between(0.6, 1.0)
    spots = []
    for _ in range(site.count(3, 6)):  # upright
        x, y, radius = site.between(0.0, back), site.between(-wide, wide), site.between(0.012, 0.06)
        site.can((x, y, 0), radius, 2.0)
        spots.append((x, y))
        if radius < 0.03:
            at = site.between(0.6, 1.3)
            site.grasp_rod((x, y, at), (x, y, at + 0.2))
        if site.chance(0.6):
            site.can((x, y, site.between(0.5, 1.5)), radius + site.between(0.02, 0.04), 0.04)
    for _ in range(site.count(2, 5)):  # level
        x, z, radius = site.between(0.0, back), site.between(0.3, 1.7), site.between(0.012, 0.06)
        slope = site.between(-0.15, 0.15)
        site.rod((x, -wide, z - slope), (x, wide, z + slope), radius)
        if radius < 0.03:
            site.grasp_rod((x, -0.2, z - 0.2 * slope / wide), (x, 0.2, z + 0.2 * slope / wide))
        if site.chance(0.5):
            y = site.between(-0.5, 0.5)
            middle = z + slope * y / wide
            site.rod((x, y - 0.03, middle), (x, y + 0.03, middle), radius + 0.03)
    for _ in range(site.count(0, 2)):  # towards the arm, and up
        y, z, radius = site.between(-wide, wide), site.between(0.5, 1.4), site.between(0.015, 0.04)
        x = site.between(-0.2, 0.1)
        site.rods([(back + 0.2, y, z), (x, y, z), (x, y, z + site.between(-0.5, 0.5))], radius)
    for _ in range(site.count(1, 2)):  # a valve with a wheel
        x, y, z = site.between(-0.15, 0.15), site.between(-0.5, 0.5), site.between(0.6, 1.3)
        turn, radius, spokes = turned(site.between(-0.6, 0.6)), site.between(0.06, 0.14), 6
        rim = [
            turn @ (0.0, radius * math.cos(a), radius * math.sin(a)) + (x, y, z)
            for a in [2 * math.pi * i / spokes for i in range(spokes + 1)]
        ]
        site.rods(rim, 0.009)
        site.rod((x, y, z), turn @ (0.25, 0.0, 0.0) + (x, y, z), 0.014)
        site.rod(rim[0], rim[3], 0.007)
        start, end = rim[1], rim[2]
        site.place(
            (start + end) / 2, (0.01, 0.01, 0.01), turn @ FORWARD, (start + end) / 2 - (x, y, z)
        )
    if site.chance(0.6):
        y, radius = site.between(-wide, wide), site.between(0.2, 0.35)
        low, high = site.between(0.3, 0.6), site.between(0.9, 1.3)
        site.rod((back + radius, y, low), (back + radius, y, high), radius)
        site.ball((back + radius, y, high), radius)
    site.place((back / 2, 0, 1.0), (back, wide, 0.8))
    site.place((back, 0, 1.0), (0.2, wide, 0.8))


def tilted_bins(site: Site) -> None:
    """A picking station: rows of bins that lean towards the arm, filled with parts."""
    rows, columns = site.count(2, 3), site.count(2, 4)
    wide, deep, tall = site.between(0.18, 0.32), site.between(0.25, 0.4), site.between(0.1, 0.2)
    lean = site.between(0.2, 0.6)
    wall, rise = site.between(0.006, 0.015), tall + site.between(0.12, 0.28)
    base = site.between(0.4, 0.8)
    turn = turned(0.0, -lean)
    approach = turn @ (0.5, 0.0, -1.0)
    for row in range(rows):
        x, z = row * site.between(0.1, 0.22), base + row * rise
        for column in range(columns):
            y = (column - (columns - 1) / 2) * (wide + 0.02)

            def at(u: float, v: float, w: float, x=x, y=y, z=z):
                return turn @ (u, v, w) + (x, y, z)

            site.box(at(deep / 2, 0, 0), (deep, wide, wall), pitch=-lean)
            site.box(at(deep, 0, tall / 2), (wall, wide, tall), pitch=-lean)
            site.box(at(0, 0, tall / 4), (wall, wide, tall / 2), pitch=-lean)
            for side in (-1, 1):
                site.box(
                    at(deep / 2, side * wide / 2, tall * 0.4), (deep, wall, tall * 0.8), pitch=-lean
                )
            for _ in range(site.count(0, 2)):
                u, v = site.between(0.08, deep - 0.08), site.between(-0.3, 0.3) * wide
                size = site.between(0.025, 0.055)
                if site.chance(0.5):
                    site.ball(at(u, v, size / 2 + wall), size / 2)
                else:
                    site.rod(at(u, v - size, size / 2), at(u, v + size, size / 2), size / 2)
                site.place(at(u, v, 0.8 * size), (0.008,) * 3, approach, turn @ (1.0, 0.0, 0.5))
            size = (deep * 0.6, wide - 0.1, tall * 0.7)
            site.place(at(deep / 2, 0, tall * 0.6), size, approach)
    span = columns * (wide + 0.02) / 2
    for side in (-1, 1):
        for x in (0.1, 0.1 + deep + 0.2 * rows):
            site.can((x, side * (span + 0.03), 0), 0.02, base + rows * rise)
    if site.chance(0.6):  # a lamp along the top
        z = base + rows * rise + 0.1
        site.box((site.between(-0.1, 0.2), 0, z), (0.1, 2 * span, 0.05))


def workbench(site: Site) -> None:
    """A bench with a vice and a drill press, tools on a board behind it, timber leaning."""
    depth, width, top = site.between(0.5, 0.75), site.between(1.1, 1.8), site.between(0.75, 0.95)
    site.box((depth / 2, 0, top - 0.04), (depth, width, 0.08))
    for x in (0.06, depth - 0.06):
        for y in (-1, 1):
            site.box((x, y * (width / 2 - 0.06), top / 2 - 0.04), (0.09, 0.09, top - 0.08))
    site.box((depth / 2, 0, site.between(0.15, 0.3)), (depth - 0.1, width - 0.1, 0.03))
    site.place((depth / 2, 0, top - 0.25), (depth * 0.7, width * 0.6, 0.25))
    board = site.between(0.6, 0.9)
    site.box((depth, 0, top + board / 2), (0.02, width, board))
    for y, z in site.spots(
        site.count(3, 6), (-0.45 * width, 0.45 * width), (top + 0.35, top + board), 0.17
    ):
        site.rod((depth, y, z), (depth - 0.07, y, z), 0.006)
        length, thick = site.between(0.12, 0.3), site.between(0.008, 0.02)
        site.rod((depth - 0.05, y, z), (depth - 0.05, y, z - length), thick)
        site.place((depth - 0.05, y, z - 0.6 * length), (0.01, 0.006, 0.05), FORWARD, (0, 1, 0))
        if site.chance(0.5):
            site.box((depth - 0.05, y, z - 0.02), (0.05, site.between(0.06, 0.14), 0.04))
    x, y = site.between(0.0, 0.12), site.between(-0.4, 0.4) * width  # the vice
    gap, turn = site.between(0.02, 0.14), site.between(-0.4, 0.4)
    across = turned(turn) @ (gap / 2 + 0.03, 0.0, 0.0)
    for side in (-1, 1):
        centre = across * side + (x, y, top + 0.09)
        site.box(centre, (0.06, site.between(0.12, 0.18), 0.18), turn)
    screw = across * 4 / (1 + 10 * gap)
    site.rod((x, y, top + 0.05), (x - screw[0], y - screw[1], top + 0.05), 0.015)
    if site.chance(0.5):
        site.rod((x, y, top), (x, y + site.between(-0.2, 0.2), top + 0.45), min(gap / 2, 0.025))
    else:
        site.place((x, y, top + 0.14), (0.01, 0.1, 0.06), DOWN, (0, 1, 0))
    x, y = depth - 0.2, -y + site.between(-0.1, 0.1)  # the drill press
    high = top + site.between(0.5, 0.75)
    site.box((x, y, top + 0.02), (0.3, 0.2, 0.04))
    site.can((x + 0.1, y, top), 0.035, high - top)
    site.box((x, y, high), (0.36, 0.14, 0.16))
    quill = site.between(0.1, 0.22)
    site.can((x - 0.1, y, high - quill), 0.025, quill)
    site.can((x - 0.1, y, high - quill - 0.08), 0.006, 0.08)
    level = top + site.between(0.1, 0.2)
    site.box((x - 0.05, y, level), (0.24, 0.2, 0.02), site.between(-0.5, 0.5))
    site.place((x - 0.1, y, (level + high - quill - 0.08) / 2), (0.16, 0.12, 0.08))
    for _ in range(site.count(1, 3)):  # timber
        foot, lean = site.between(-0.5, 0.5) * width, site.between(-0.3, 0.3)
        size = (site.between(0.03, 0.05), site.between(0.05, 0.12), 1.6)
        site.box((-0.05, foot + lean * 0.8, 0.8), size, 0.0, site.between(0.05, 0.2), -lean)
    site.things(site.count(1, 4), (0.1, depth - 0.1), (-0.45 * width, 0.45 * width), top, 0.25)
    site.place((depth / 2, 0, top + 0.1), (depth * 0.7, width * 0.8, 0.15), INTO)
