"""Families of wide scenes: furniture and machines of homes. All lengths in m."""

import math

from roboarm_nmp.envs.scenes.wide_scenes.site import DOWN, FORWARD, INTO, Site, turned


def kitchen(site: Site) -> None:
    """A worktop with a tap and jars, a wall behind it, and cupboards above, open or closed."""
    depth, width = site.between(0.45, 0.7), site.between(0.9, 1.8)
    top, board = site.between(0.85, 0.95), site.between(0.02, 0.05)
    site.box((depth / 2, 0, top - board / 2), (depth, width, board))
    site.box((depth / 2 + 0.04, 0, (top - board) / 2), (depth - 0.08, width, top - board))
    site.box((depth + 0.015, 0, top + 0.45), (0.03, width, 0.9))
    gap = site.between(0.3, 0.65)
    shelf = site.between(0.22, 0.38)
    left = site.between(-width / 2, 0.1)
    right = site.between(left + 0.35, width / 2 + 0.3)
    low, high = top + gap, top + gap + site.between(0.3, 0.7)
    is_open = site.chance(0.6)
    site.case((depth - shelf, left, low), (depth, right, high), 0.02, "f" if is_open else "")
    if is_open:
        middle = (low + high) / 2
        site.place(
            (depth - shelf / 2, (left + right) / 2, middle),
            (shelf, right - left - 0.08, high - low - 0.12),
        )
        site.things(
            2,
            (depth - shelf + 0.06, depth - 0.08),
            (left + 0.08, right - 0.08),
            low + 0.02,
            high - low - 0.08,
        )
    if site.chance(0.5):  # a door of the cupboard, ajar
        leaf, ajar = (right - left) / 2, site.between(0.6, 2.2)
        x, y = depth - shelf - leaf / 2 * math.sin(ajar), left + leaf / 2 * math.cos(ajar)
        site.box((x, y, (low + high) / 2), (0.02, leaf, high - low), ajar)
    tap, rise = site.between(-0.4, 0.4) * width, site.between(0.15, min(0.35, gap - 0.03))
    reach = site.between(0.12, 0.22)
    site.rods(
        [
            (depth - 0.07, tap, top),
            (depth - 0.07, tap, top + rise),
            (depth - 0.07 - reach, tap, top + rise),
            (depth - 0.07 - reach, tap, top + rise - 0.05),
        ],
        site.between(0.01, 0.016),
    )
    site.place((depth - 0.07 - reach / 2, tap, top + rise / 2), (reach, 0.1, rise * 0.6))
    site.things(site.count(2, 6), (0.08, depth - 0.1), (-0.45 * width, 0.45 * width), top, gap)
    site.place((depth / 2, 0, top + 0.05 + gap / 2), (depth * 0.8, width * 0.8, gap * 0.7), INTO)


def desk(site: Site) -> None:
    """A desk with a screen on an arm and a lamp, a chair in front of it, a bin below."""
    depth, width = site.between(0.5, 0.85), site.between(1.0, 1.7)
    top, board = site.between(0.66, 0.8), site.between(0.02, 0.04)
    site.box((depth / 2, 0, top - board / 2), (depth, width, board))
    if site.chance(0.5):
        for y in (-1, 1):
            site.box((depth / 2, y * (width / 2 - 0.02), top / 2), (depth, 0.03, top))
    else:
        for x in (0.05, depth - 0.05):
            for y in (-1, 1):
                site.can((x, y * (width / 2 - 0.06), 0), site.between(0.015, 0.04), top - board)
    if site.chance(0.7):
        site.box((depth - 0.02, 0, top - 0.22), (0.02, width - 0.1, 0.3))  # modesty panel
    y, tall = site.between(-0.3, 0.3) * width, site.between(0.25, 0.4)
    site.rods(
        [(depth - 0.1, y, top), (depth - 0.1, y, top + 0.3), (depth - 0.22, y + 0.1, top + 0.35)],
        0.018,
    )
    site.box(
        (depth - 0.25, y + 0.1, top + 0.35),
        (0.03, site.between(0.4, 0.7), tall),
        site.between(-0.4, 0.4),
        site.between(-0.3, 0.2),
    )
    y = -y + site.between(-0.1, 0.1)
    site.rods(
        [(depth - 0.1, y, top), (depth - 0.05, y, top + 0.35), (depth - 0.3, y, top + 0.5)], 0.01
    )
    site.prism(
        [
            (depth - 0.36, top + 0.42),
            (depth - 0.24, top + 0.42),
            (depth - 0.28, top + 0.53),
            (depth - 0.32, top + 0.53),
        ],
        y - 0.05,
        y + 0.05,
    )
    x, y, seat = site.between(-0.3, 0.2), site.between(-0.3, 0.3) * width, site.between(0.4, 0.5)
    wide = site.between(0.38, 0.48)
    site.box((x, y, seat), (wide, wide, 0.05))
    site.box((x - wide / 2, y, seat + 0.3), (0.03, wide, 0.35), pitch=site.between(-0.3, 0.0))
    for u in (-1, 1):
        for v in (-1, 1):
            site.rod(
                (x + u * 0.15, y + v * 0.15, seat),
                (x + u * 0.2, y + v * 0.2, 0),
                site.between(0.012, 0.02),
            )
    under = top - board - 0.05
    bin_y = site.between(-0.35, 0.35) * width
    site.case((depth - 0.35, bin_y - 0.12, 0), (depth - 0.1, bin_y + 0.12, 0.3), 0.012, "t")
    site.place((depth - 0.225, bin_y, 0.25), (0.14, 0.14, 0.15), DOWN)
    site.place((depth / 2, 0, under - 0.12), (depth * 0.7, width * 0.8, 0.2))
    site.things(site.count(2, 5), (0.08, depth - 0.25), (-0.42 * width, 0.42 * width), top, 0.3)
    site.place((depth / 2, 0, top + 0.12), (depth * 0.8, width * 0.8, 0.2), INTO)


def drawers(site: Site) -> None:
    """A chest of drawers, one or two of them pulled out, with things in them and on top."""
    depth, width, board = site.between(0.4, 0.6), site.between(0.4, 1.0), site.between(0.01, 0.025)
    heights = [site.between(0.12, 0.3) for _ in range(site.count(3, 5))]
    foot = site.between(0.0, 0.15)
    total = foot + sum(heights)
    site.case((0, -width / 2, foot), (depth, width / 2, total + board), board, "f")
    pulled = site.rng.permutation(len(heights))[: site.count(1, 2)]
    low = foot + board
    for level, height in enumerate(heights):
        high = low + height - board
        out = site.between(0.18, 0.42) if level in pulled else 0.0
        inside = width / 2 - board
        site.box((-out - 0.01, 0, (low + high) / 2), (0.02, width - 0.01, high - low))
        for y in (-0.06, 0.06):
            site.rod((-out - 0.01, y, (low + high) / 2), (-out - 0.06, y, (low + high) / 2), 0.006)
        bar = [(-out - 0.06, y, (low + high) / 2) for y in (-0.07, 0.07)]
        site.rod(bar[0], bar[1], 0.007)
        site.place((-out - 0.06, 0, (low + high) / 2), (0.006, 0.05, 0.006), FORWARD, (0, 0, 1))
        if out:
            wall = (high - low) * site.between(0.6, 0.9)
            site.box((depth / 2 - out, 0, low + board / 2), (depth - 0.04, 2 * inside, board))
            for y in (-1, 1):
                site.box(
                    (depth / 2 - out, y * (inside - board / 2), low + wall / 2),
                    (depth - 0.04, board, wall),
                )
            site.things(
                site.count(1, 4),
                (-out + 0.06, -0.05),
                (-inside + 0.08, inside - 0.08),
                low + board,
                wall,
            )
            site.place(
                (-out / 2, 0, low + board + wall / 2), (out - 0.04, 2 * inside - 0.1, wall), DOWN
            )
        low += height
    site.things(
        site.count(1, 4), (0.08, depth - 0.06), (-0.4 * width, 0.4 * width), total + board, 0.3
    )
    site.place((depth / 2, 0, total + 0.12), (depth * 0.8, width * 0.8, 0.15), INTO)


def dish_rack(site: Site) -> None:
    """A dishwasher with its door down, and a rack of plates and glasses pulled out of it."""
    width, depth, high = site.between(0.5, 0.7), site.between(0.5, 0.6), site.between(0.7, 0.85)
    base = site.between(0.1, 0.2)
    site.case((0, -width / 2, base), (depth, width / 2, high), 0.03, "f")
    slope = site.between(-0.1, 0.25)
    door = site.between(0.4, 0.6)
    site.box(
        (-door / 2 * math.cos(slope), 0, base + door / 2 * math.sin(slope)),
        (door, width, 0.04),
        pitch=slope,
    )
    out, level = site.between(0.15, 0.5), base + site.between(0.12, 0.2)
    front, half = -out, width / 2 - 0.05
    back = front + depth - 0.06
    site.box(((front + back) / 2, 0, level), (back - front, 2 * half, 0.01))
    rim = level + site.between(0.08, 0.14)
    for a, b in (
        ((front, -half), (front, half)),
        ((front, -half), (back, -half)),
        ((front, half), (back, half)),
    ):
        site.rod((*a, rim), (*b, rim), 0.006)
        site.rod((*a, level), (*a, rim), 0.006)
    x, step, lean = front + 0.14, site.between(0.05, 0.1), site.between(-0.25, 0.25)
    y = -half + 0.06
    edge = site.between(-0.1, 0.1)
    while y < edge:  # plates
        radius, thick = site.between(0.08, 0.13), site.between(0.008, 0.02)
        if site.chance(0.75):
            normal = turned(0.0, 0.0, lean) @ (0.0, thick / 2, 0.0)
            middle = (x, y, level + radius + 0.01)
            site.rod(middle - normal, middle + normal, radius)
            site.place((x, y, middle[2] + radius - 0.02), (0.02, 0.004, 0.02), DOWN, (0, 1, 0))
        else:
            site.place((x, y, level + 0.12), (0.1, step / 2, 0.12), DOWN, (1, 0, 0))
        y += step
    for spot in site.spots(
        site.count(2, 5), (front + 0.06, back - 0.1), (edge + 0.06, half - 0.04), 0.1
    ):
        radius, height = site.between(0.02, 0.04), site.between(0.08, 0.16)
        site.can((*spot, level + 0.005), radius, height)
        if radius < 0.03:
            site.grasp_from_above((*spot, level), 2 * radius, height, site.between(-3, 3))
    if site.chance(0.6):  # the upper rack, a little out
        site.box((depth / 2 - out / 3, 0, high - 0.25), (depth - 0.06, 2 * half, 0.02))
    site.place((0.2, 0, level + 0.12), (0.3, half, 0.12), INTO)


def washing_drum(site: Site) -> None:
    """A machine with a round drum that faces the arm, its door open, laundry inside."""
    radius, depth = site.between(0.16, 0.3), site.between(0.3, 0.5)
    middle, staves = site.between(0.45, 1.0), site.count(9, 14)
    pitch = -site.between(0.0, 0.5)  # the drum's mouth looks up
    turn = turned(0.0, pitch)
    start = len(site.parts)
    thick = site.between(0.01, 0.04)
    for i in range(staves):
        angle = 2 * math.pi * (i + 0.5) / staves
        y, z = math.cos(angle), math.sin(angle)
        chord = 2 * (radius + thick) * math.tan(math.pi / staves)
        middle_of = ((radius + thick / 2) * y, (radius + thick / 2) * z)
        site.box((depth / 2, *middle_of), (depth, thick, chord), roll=angle)
    site.rod((depth, 0, 0), (depth + 0.03, 0, 0), radius)
    frame = site.between(0.08, 0.2)  # the front around the mouth
    side = 2 * (radius + frame)
    for u, v in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        centre = (0.015, u * (radius + frame / 2 + 0.01), v * (radius + frame / 2 + 0.01))
        size = (0.03, frame if u else side, frame if v else side)
        site.box(centre, size)
    hinge, ajar = radius + 0.03, site.between(1.3, 2.6)
    x, y = -radius * math.sin(ajar), hinge - radius * math.cos(ajar)
    normal = turned(-ajar) @ (0.02, 0.0, 0.0)
    site.rod((x, y, 0) - normal, (x, y, 0) + normal, radius)
    for _ in range(site.count(0, 5)):
        size = [site.between(0.06, 0.16) for _ in range(3)]
        site.lump(
            (
                site.between(0.1, depth - 0.05),
                site.between(-0.5, 0.5) * radius,
                -radius * site.between(0.5, 0.85),
            ),
            size,
        )
    site.place((depth * 0.5, 0, 0.05), (depth * 0.8, radius, radius), (1.0, 0.0, -0.1))
    site.place((depth * 0.5, 0, -0.3 * radius), (depth * 0.8, radius, radius), (0.9, 0.0, -0.4))
    site.turn_parts(start, turn, (0.0, 0.0, middle))
    if site.chance(0.5):  # a tub in front
        low = middle - radius - site.between(0.25, 0.5)
        site.case((-0.5, -0.25, low), (-0.1, 0.25, low + 0.2), 0.02, "t")
    site.box((depth / 2, 0, middle + radius + 0.3), (depth, side, site.between(0.02, 0.1)))


def bottle_rack(site: Site) -> None:
    """A rack of crossing diagonal boards, with bottles lying in some of its cells."""
    depth, board = site.between(0.2, 0.4), site.between(0.012, 0.025)
    cell = site.between(0.2, 0.34)
    width, height = cell * site.count(2, 4), cell * site.count(2, 4)
    low = site.between(0.1, 0.6)
    site.case((0, -width / 2, low), (depth, width / 2, low + height), board, "f")
    lines = site.count(2, 4)
    pitch = cell * site.between(0.85, 1.1)
    for slope in (1, -1):
        for i in range(-lines, lines + 1):
            # y = slope * z + offset, where that is inside the frame
            offset = i * pitch
            middle = -slope * offset
            ends = max(-height, 2 * middle - width) / 2, min(height, 2 * middle + width) / 2
            if ends[1] - ends[0] > 0.1:
                z = (ends[0] + ends[1]) / 2
                site.box(
                    (depth / 2, slope * z + offset, low + height / 2 + z),
                    (depth, board, (ends[1] - ends[0]) * math.sqrt(2)),
                    roll=-slope * math.pi / 4,
                )
    for row in range(-2 * lines, 2 * lines + 1):
        for column in range(-2 * lines, 2 * lines + 1):
            y, z = column * pitch / 2, row * pitch / 2
            inside = abs(y) < width / 2 - 0.3 * pitch and abs(z) < height / 2 - 0.3 * pitch
            if inside and (row + column) % 2:
                at = low + height / 2 + z
                if site.chance(0.35):
                    radius = site.between(0.03, 0.045)
                    out = site.between(-0.05, 0.12)
                    rest = at - pitch / 2 + radius * math.sqrt(2) + board
                    site.rod((depth - 0.02, y, rest), (-out + 0.1, y, rest), radius)
                    site.rod((-out + 0.1, y, rest), (-out, y, rest), 0.015)
                    site.place((-out + 0.02, y, rest), (0.03, 0.006, 0.006), FORWARD, (0, 1, 0))
                    site.place((-out + 0.02, y, rest), (0.03, 0.006, 0.006), FORWARD, (0, 1, 1))
                else:
                    size = (depth, pitch * 0.3, pitch * 0.3)
                    site.place((depth / 2 - 0.03, y, at), size)
    site.things(
        site.count(0, 3), (0.08, depth - 0.05), (-0.4 * width, 0.4 * width), low + height, 0.3
    )
