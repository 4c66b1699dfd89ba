"""Families of wide scenes: vehicles, greenhouses, building sites. All lengths in m."""

import math

import numpy as np

from roboarm_nmp.envs.scenes.wide_scenes.site import DOWN, FORWARD, INTO, Site, turned


def car_cabin(site: Site) -> None:
    """A car's open door: sill, pillars and roof, a seat, a steering wheel and the dashboard."""
    sill, roof = site.between(0.3, 0.5), site.between(1.25, 1.55)
    front, rear = site.between(0.5, 0.7), -site.between(0.35, 0.55)  # along y
    thick = site.between(0.03, 0.06)
    site.box((0.05, 0, sill / 2), (0.14, front - rear + 0.6, sill))
    slope = site.between(0.2, 0.45)
    site.rods([(0, rear, sill), (0, rear + 0.05, 0.9), (0.1, rear + 0.12, roof)], thick)
    site.rods([(0, front + 0.1, sill), (0, front, 0.85), (0.1, front - slope, roof)], thick)
    site.rod((0.1, rear, roof), (0.1, front - slope, roof), thick)
    site.box((0.7, (rear + front - slope) / 2, roof + 0.02), (1.2, front - slope - rear, 0.03))
    site.box((0.7, 0, sill - 0.08), (1.2, front - rear + 0.5, 0.04))  # the floor
    seat, y = sill + site.between(0.0, 0.15), rear + site.between(0.25, 0.45)
    half = site.between(0.22, 0.28)
    x = site.between(0.4, 0.5)
    site.prism(
        [
            (x - half, seat - 0.1),
            (x + half, seat - 0.1),
            (x + half, seat + 0.06),
            (x + half - 0.05, seat + 0.04),
            (x - half + 0.05, seat + 0.04),
            (x - half, seat + 0.06),
        ],
        y - 0.22,
        y + 0.25,
    )
    back = site.between(0.1, 0.6)
    site.box(
        (x, y - 0.25 - 0.3 * math.sin(back), seat + 0.3 * math.cos(back)),
        (2 * half, 0.1, 0.6),
        roll=back,
    )
    site.box(
        (x, y - 0.27 - 0.7 * math.sin(back), seat + 0.72 * math.cos(back)),
        (0.25, 0.08, 0.16),
        roll=back,
    )
    dash, deep = site.between(0.8, 0.92), site.between(0.2, 0.35)
    site.hull(
        [
            (u, front - deep + v, w)
            for u in (0.1, 1.2)
            for v, w in (
                (0, dash - 0.08),
                (0.05, dash),
                (deep + 0.1, dash),
                (0.1, dash - 0.3),
                (deep + 0.1, dash - 0.3),
            )
        ]
    )
    radius, tilt, spokes = site.between(0.16, 0.2), site.between(0.3, 0.7), 8
    centre = np.array([x, front - deep - site.between(0.12, 0.3), dash - site.between(0.0, 0.1)])
    turn = turned(0.0, 0.0, math.pi / 2 - tilt)
    angles = [2 * math.pi * i / spokes for i in range(spokes + 1)]
    rim = [turn @ (radius * math.cos(a), radius * math.sin(a), 0.0) + centre for a in angles]
    site.rods(rim, 0.013)
    site.rod(rim[0], rim[4], 0.012)
    site.rod(centre, (x, front - 0.05, centre[2] - 0.15), 0.035)
    for i in (3, 4, 5):
        middle = (rim[i] + rim[i - 1]) / 2
        site.place(middle, (0.01,) * 3, FORWARD, turn @ (0.0, 0.0, 1.0))
    site.box((0.78, y + 0.15, seat - 0.02), (0.14, 0.7, 0.2))  # between the seats
    if site.chance(0.6):
        site.rods([(0.78, y + 0.3, seat), (0.78, y + 0.33, seat + 0.16)], 0.012)
        site.ball((0.78, y + 0.33, seat + 0.18), 0.022)
    site.place((x, y + 0.1, seat + 0.2), (0.4, 0.5, 0.25))
    site.place((x, front - deep, sill + 0.12), (0.4, 0.25, 0.2), INTO)
    site.place((x, front - 0.1, dash + 0.12), (0.5, 0.3, 0.1))
    site.place((0.8, y - 0.35, roof - 0.35), (0.5, 0.3, 0.3))


def fuselage(site: Site) -> None:
    """The inside of an aircraft's hull: round frames, stringers along it, skin, and a duct."""
    radius, thick = site.between(0.8, 1.6), site.between(0.02, 0.04)
    web = site.between(0.06, 0.14)  # how far a frame stands out from the skin
    step = site.between(0.35, 0.6)
    low, high = -site.between(0.5, 0.8), site.between(0.5, 0.8)  # rad
    middle = site.between(0.8, 1.1)
    facets = 4
    bend = (high - low) / facets

    def at(angle: float, inwards: float) -> tuple[float, float]:
        reach = radius - inwards
        return 0.6 - radius + reach * math.cos(angle), middle + reach * math.sin(angle)

    frames = [i * step for i in (-1.5, -0.5, 0.5, 1.5)]
    span = frames[-1] - frames[0] + 0.3
    for i in range(facets):
        angle = low + (i + 0.5) * bend
        chord = 2 * radius * math.tan(bend / 2)
        x, z = at(angle, -0.01)
        site.box((x, 0, z), (0.02, span, chord), pitch=-angle)
        x, z = at(angle, web / 2)
        for y in frames:
            site.box((x, y, z), (web, thick, chord), pitch=-angle)
    for _ in range(site.count(3, 6)):
        x, z = at(site.between(low, high), site.between(0.02, 0.05))
        site.rod((x, -span / 2, z), (x, span / 2, z), site.between(0.01, 0.025))
    for a, b in zip(frames, frames[1:], strict=False):
        for i in range(facets):
            x, z = at(low + (i + 0.5) * bend, web * 0.8 + 0.03)
            site.place((x, (a + b) / 2, z), (web * 0.8, step - 0.14, chord * 0.5))
    for y in site.rng.choice(frames, 2, replace=False):
        x, z = at(site.between(low, high) * 0.7, web - 0.015)
        site.place((x, y, z), (0.01, 0.004, 0.05), FORWARD, (0, 1, 0))
    x, z = at(site.between(low, high), web + site.between(0.08, 0.2))
    site.rod((x, -span / 2, z), (x, span / 2, z), site.between(0.03, 0.08))
    if site.chance(0.7):  # the cabin's floor on its beams
        level = middle - site.between(0.4, 0.6)
        site.box((0.2, 0, level), (0.6, span, 0.03))
        for y in frames:
            site.box((0.3, y, level - 0.07), (0.5, thick, 0.1))
    if site.chance(0.6):  # a clip-board of wires
        y = site.between(-0.5, 0.5)
        bends = [at(a, web + 0.03) for a in np.linspace(low, high, 4)]
        site.rods([(x, y + site.between(-0.1, 0.1), z) for x, z in bends], 0.012)


def greenhouse(site: Site) -> None:
    """Plants in a row on a gutter: stems, leaves and fruit, tied to strings between posts."""
    top, width = site.between(0.3, 0.8), site.between(1.0, 1.6)
    site.box((0.15, 0, top - 0.05), (site.between(0.15, 0.3), width, 0.1))
    for y in (-0.4, 0.4):
        site.can((0.15, y * width, 0), 0.025, top - 0.1)
    high = top + site.between(0.8, 1.1)
    for y in (-0.5, 0.5):
        site.can((0.15, y * width, 0), site.between(0.02, 0.035), high)
    site.rod((0.15, -width / 2, high), (0.15, width / 2, high), 0.02)
    plants = site.count(3, 5)
    for number in range(plants):
        y = ((number + 0.5) / plants - 0.5) * width + site.between(-0.06, 0.06)
        stem = [np.array([0.15, y, top])]
        joints = 3
        for _ in range(joints):
            rise = (high - top) / joints * site.between(0.75, 1.0)
            stem.append(stem[-1] + (site.between(-0.08, 0.08), site.between(-0.08, 0.08), rise))
        site.rods(stem, site.between(0.007, 0.014))
        for low, up in zip(stem, stem[1:], strict=False):
            foot = low + site.between(0.2, 0.9) * (up - low)
            azimuth, droop = site.between(-math.pi, math.pi), site.between(-0.4, 0.9)
            leaf, half = site.between(0.1, 0.26), site.between(0.03, 0.07)
            turn = turned(azimuth, droop, site.between(-0.5, 0.5))
            outline = (
                (0.02, 0),
                (0.35 * leaf, half),
                (0.75 * leaf, 0.8 * half),
                (leaf, 0),
                (0.75 * leaf, -0.8 * half),
                (0.35 * leaf, -half),
            )
            site.hull([turn @ (u, v, w) + foot for u, v in outline for w in (-0.003, 0.003)])
            if site.chance(0.55):
                side, radius = site.between(-math.pi, math.pi), site.between(0.018, 0.042)
                hang = site.between(0.03, 0.09)
                end = foot + (
                    math.cos(side) * (radius + 0.03),
                    math.sin(side) * (radius + 0.03),
                    -hang,
                )
                site.rod(foot, end, 0.004)
                fruit = end - (0.0, 0.0, radius)
                site.ball(fruit, radius)
                if radius < 0.03:
                    across = (math.sin(side), -math.cos(side), 0.0)
                    site.place(fruit, (0.008,) * 3, (math.cos(side) * 0.3 + 0.8, 0.3, -0.2), across)
                    site.place(fruit, (0.008,) * 3, (1.0, 0.0, 0.3), (0, 1, 0))
        if site.chance(0.6):
            radius = site.between(0.06, 0.1)
            site.can((0.15, y, top), radius, site.between(0.06, 0.14))
    site.place((0.15, 0, (top + high) / 2), (0.25, width * 0.8, (high - top) * 0.6))
    site.place((0.35, 0, (top + high) / 2), (0.2, width * 0.8, (high - top) * 0.6))
    if site.chance(0.5):  # the next row
        site.box((0.9, 0, top - 0.05), (0.2, width, 0.1))
        for y in np.linspace(-0.4, 0.4, 3) * width:
            site.lump((0.9, y, top + 0.4), (0.35, 0.35, site.between(0.5, 0.9)), 16)


def rubble(site: Site) -> None:
    """A heap of stones, bricks and broken slabs, with beams and bars that stick out of it."""
    wide = site.between(0.4, 0.8)
    heap = site.between(0.2, 0.6)
    for _ in range(site.count(8, 14)):
        x, y = site.between(0.0, 0.8), site.between(-wide, wide)
        level = heap * max(0.0, 1.0 - math.hypot((x - 0.45) / 0.6, y / wide) ** 2)
        size = [site.between(0.12, 0.4) for _ in range(3)]
        site.lump((x, y, level - 0.02), size, site.count(8, 14))
        if site.chance(0.4):
            site.place((x, y, level + size[2] / 2 + 0.06), (0.1, 0.1, 0.06), DOWN)
    site.lump((0.45, 0, heap / 3), (1.1, 1.8 * wide, heap), 16)
    for _ in range(site.count(3, 7)):  # bricks
        x, y = site.between(0.0, 0.8), site.between(-wide, wide)
        level = heap * max(0.0, 1.0 - math.hypot((x - 0.45) / 0.6, y / wide) ** 2)
        turn = [site.between(-1.5, 1.5), site.between(-0.6, 0.6), site.between(-0.6, 0.6)]
        site.box((x, y, level + 0.08), (0.24, 0.115, 0.07), *turn)
    for _ in range(site.count(1, 3)):  # slabs, that make hollows
        x, y = site.between(0.2, 0.7), site.between(-0.6, 0.6) * wide
        pitch, roll = site.between(-0.9, 0.2), site.between(-0.5, 0.5)
        size = (site.between(0.4, 0.8), site.between(0.3, 0.7), site.between(0.04, 0.1))
        level = heap + site.between(0.1, 0.35)
        site.box((x, y, level), size, site.between(-0.5, 0.5), pitch, roll)
        site.place((x - 0.1, y, level - 0.18), (0.3, 0.25, 0.12))
        site.place((x - 0.1, y, level + 0.12), (0.3, 0.25, 0.1), INTO)
    for _ in range(site.count(2, 5)):  # bars and beams
        foot = np.array([site.between(0.1, 0.7), site.between(-wide, wide), heap * 0.4])
        lean = np.array([site.between(-0.5, 0.2), site.between(-0.4, 0.4), 1.0])
        length = site.between(0.4, 0.9)
        tip = foot + length * lean / np.linalg.norm(lean)
        radius = site.between(0.007, 0.03)
        site.rod(foot, tip, radius)
        if radius < 0.027:
            site.grasp_rod(foot + 0.5 * (tip - foot), tip)
    beam = site.between(0.08, 0.16)
    yaw, pitch = site.between(-1.2, 1.2), site.between(-0.5, 0.3)
    site.box((0.4, site.between(-0.3, 0.3), heap + 0.3), (1.3, beam, beam), yaw, pitch)
    site.place((0.3, 0, heap + 0.15), (0.4, wide, 0.15), INTO)


def scaffold(site: Site) -> None:
    """A scaffold in front of a wall: tubes, braces, decks, and a bucket."""
    tube, bay = site.between(0.02, 0.03), site.between(0.8, 1.3)
    deep, lift = site.between(0.5, 0.8), site.between(0.7, 1.1)
    posts = [-bay / 2, bay / 2] if site.chance(0.5) else [-bay, 0.0, bay]
    first = site.between(0.4, 0.8)
    levels = [first, first + lift]
    for y in posts:
        for x in (0.0, deep):
            site.can((x, y, 0), tube, levels[-1] + 0.6)
        for z in levels:
            site.rod((-0.1, y, z - 0.04), (deep + 0.15, y, z - 0.04), tube)
    for z in (*levels, levels[0] + 0.5):
        x = site.rng.choice([0.0, deep])
        site.rod((x, posts[0] - 0.15, z - 0.08), (x, posts[-1] + 0.15, z - 0.08), tube)
        site.grasp_rod((x, -0.2, z - 0.08), (x, 0.2, z - 0.08))
    for _ in range(site.count(1, 2)):
        x = site.rng.choice([-0.04, deep + 0.04])
        ends = [(x, posts[0], levels[0]), (x, posts[1], levels[1])]
        site.rod(ends[0], ends[1], tube)
        if site.chance(0.3):
            site.rod((x, posts[0], levels[1]), (x, posts[1], levels[0]), tube)
    for z in levels:  # decks of planks, some missing
        planks = 3
        wide = deep / planks
        for i in range(planks):
            if site.chance(0.75):
                slip = site.between(-0.1, 0.1)
                site.box(((i + 0.5) * wide, slip, z), (wide - 0.02, posts[-1] - posts[0], 0.04))
        if site.chance(0.5):
            site.box((-0.02, 0, z + 0.1), (0.03, posts[-1] - posts[0], 0.15))  # toe board
    wall = deep + site.between(0.15, 0.35)
    low, high = levels[0] + site.between(0.2, 0.4), levels[0] + site.between(0.7, 1.1)
    half = site.between(0.3, 0.5)
    for size, centre in (  # the wall around a window
        ((0.12, 3.0, low), (wall, 0, low / 2)),
        ((0.12, 3.0, 0.8), (wall, 0, high + 0.4)),
        ((0.12, 1.5 - half, high - low), (wall, (1.5 + half) / 2, (low + high) / 2)),
        ((0.12, 1.5 - half, high - low), (wall, -(1.5 + half) / 2, (low + high) / 2)),
    ):
        site.box(centre, size)
    site.place((wall, 0, (low + high) / 2), (0.3, 2 * half - 0.2, high - low - 0.2))
    x, y, z = site.between(0.15, deep - 0.15), site.between(-0.25, 0.25), levels[0] + 0.02
    radius, tall, staves = site.between(0.12, 0.16), site.between(0.2, 0.28), 8
    for i in range(staves):  # a bucket
        angle = 2 * math.pi * i / staves
        chord = 2 * radius * math.tan(math.pi / staves)
        centre = (x + radius * math.cos(angle), y + radius * math.sin(angle), z + tall / 2)
        site.box(centre, (0.008, chord, tall), angle)
        across = (math.cos(angle), math.sin(angle), 0.0)
        site.place((*centre[:2], z + tall - 0.015), (0.004, 0.01, 0.02), DOWN, across)
    site.things(site.count(1, 4), (0.05, deep - 0.05), (-0.5, 0.5), z, 0.2)
    site.place((deep / 2, 0, levels[0] + 0.2), (deep, bay * 0.8, 0.25), INTO)
    site.place((deep / 2, 0, levels[1] - 0.25), (deep, bay * 0.8, 0.25))
    site.place((deep / 2, 0, levels[0] - 0.25), (deep, bay * 0.8, 0.2))


def stud_wall(site: Site) -> None:
    """The timber frame of a wall: studs, noggins, a window, panels on a part of it, a ladder."""
    step, thick, deep = site.between(0.32, 0.6), site.between(0.04, 0.06), site.between(0.08, 0.15)
    bays, high = site.count(3, 5), site.between(1.7, 2.2)
    edges = [(i - bays / 2) * step for i in range(bays + 1)]
    for z in (thick / 2, high):
        site.box((deep / 2, 0, z), (deep, bays * step + thick, thick))
    window = site.count(0, bays - 2)
    for y in edges:
        site.box((deep / 2, y, high / 2), (deep, thick, high))
    for i, (a, b) in enumerate(zip(edges, edges[1:], strict=False)):
        middle, free = (a + b) / 2, step - thick
        levels = sorted([site.between(0.5, 0.8), site.between(1.1, 1.5)])
        if i == window:  # sill and lintel
            levels = [site.between(0.6, 0.8), site.between(1.3, 1.6)]
        elif site.chance(0.3):
            levels = levels[:1]
        for z in levels:
            site.box((deep / 2, middle, z), (deep, free, thick))
        for low, up in zip([0.3, *levels], [*levels, high], strict=False):
            size = (deep + 0.25, free - 0.12, max(up - low - 0.15, 0.05))
            site.place((deep / 2 + 0.1, middle, (low + up) / 2), size)
        if i != window and site.chance(0.3):  # a panel on the front or on the back
            x = -0.007 if site.chance(0.4) else deep + 0.007
            tall = site.between(0.5, high)
            bottom = 0.0 if site.chance(0.5) else high - tall
            site.box((x, middle, bottom + tall / 2), (0.014, step, tall))
    for _ in range(site.count(1, 3)):  # cables and pipes through the studs
        z, radius = site.between(0.5, 1.5), site.between(0.008, 0.025)
        ends = [(deep / 2, edges[0], z), (deep / 2, edges[-1], z)]
        site.rod(ends[0], ends[1], radius)
        a = edges[site.count(0, bays - 1)]
        site.place((deep / 2, a + step / 2, z), (0.008, step / 2, 0.008), FORWARD, (0, 0, 1))
    if site.chance(0.6):  # a ladder
        y, x, lean = site.between(-0.5, 0.5), -site.between(0.25, 0.5), site.between(0.1, 0.25)
        top = x + lean * 1.8
        for side in (-0.2, 0.2):
            site.rod((x, y + side, 0), (top, y + side, 1.8), 0.02)
        for z in np.arange(0.3, 1.7, 0.3):
            at = x + lean * z
            site.rod((at, y - 0.2, z), (at, y + 0.2, z), 0.014)
            site.grasp_rod((at, y - 0.12, z), (at, y + 0.12, z))
    if site.chance(0.5):  # a trestle behind
        level = site.between(0.6, 0.9)
        site.box((deep + 0.45, 0, level), (0.4, bays * step, 0.04))
        site.things(3, (deep + 0.3, deep + 0.55), (-0.5, 0.5), level + 0.02, 0.3)
