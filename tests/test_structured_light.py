"""The physics of the light transport, not its pictures."""

import dataclasses

import numpy as np
import pytest
from scenes import tube_pose
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics
from tubepose.labware import WallOptics, load_cap, load_rack, load_tube
from tubepose.simulation import raycast
from tubepose.simulation.camera import NO_NOISE, default_camera
from tubepose.simulation.scene import Finishes, Liquid, Material, PlacedTube, Scene
from tubepose.simulation.structured_light import light_map, optics, parts, paths, photons, sensor, shapes
from tubepose.simulation.structured_light.codes import OUTSIDE
from tubepose.simulation.structured_light.intersection import first_hits
from tubepose.simulation.structured_light.parts import BoxPart, Piece, RevolvedPart
from tubepose.simulation.structured_light.projector import Projector, projector_of, towards
from tubepose.transforms import invert_transform, make_transform, transform_points, translation

MATTE = Material(0.5)
CLEAR = WallOptics(refractive_index=1.49)
EFFORT = sensor.Effort(photons_per_mm2=4.0, rounds=0)


def look(s, projector, origins, directions, samples=16, per_steradian=4e5, seed=1):
    """Mean sums (N, 8) along rays."""
    m = light_map.make_light_map(s)
    photons.light_through_plastic(s, m, projector, per_steradian, seed, 2)
    sums, squares = np.zeros((len(origins), 8)), np.zeros(len(origins))
    paths.radiance(s, m, projector, origins, directions, samples, seed, sums, squares, *paths.scratch())
    return sums / samples


def column_of(sums):
    """Projector column of sums (8,), as the camera decodes it."""
    column = np.arctan2(sums[3], sums[2]) % (2 * np.pi) * 1024 / (2 * np.pi)
    for i, period in ((1, 128.0), (2, 16.0)):
        wrapped = np.arctan2(sums[3 + 2 * i], sums[2 + 2 * i]) * period / (2 * np.pi)
        column = wrapped + period * np.round((column - wrapped) / period)
    return column


# Slab: light that crosses a plane plate twice.

HEIGHT, THICK, SLAB_LOW = 0.5, 0.02, 0.05
SLAB_PROJECTOR = Projector(
    np.array([0.2, 0.0, HEIGHT]), np.diag([1.0, -1.0, -1.0]), np.array([640.0, 512.0, 0.8, np.pi / 4])
)


def slab(plastic):
    """A plate as wide as the scene, 50 mm above a dark table."""
    edge = np.array([[0.0, 0.0], [0.0, 0.12], [THICK, 0.12], [THICK, 0.0]])
    profile = np.tile([0.12, 0.0], (round(THICK / parts.PROFILE_STEP_M), 1))
    pose = translation([0.0, 0.0, SLAB_LOW])
    plate = RevolvedPart(pose, (Piece(parts.segments_of(edge), OUTSIDE, MATTE),), plastic, profile)
    # Polished: no gloss of the plate itself.
    return shapes.make_shapes([plate], [], Material(0.05), MATTE, None, 0.5, 1e-3)


def seen_through(plastic, x=0.0):
    """Sums of the table's point (x, 0), seen straight from above."""
    return look(slab(plastic), SLAB_PROJECTOR, np.array([[x, 0.0, HEIGHT]]), np.array([[0.0, 0.0, -1.0]]), 400, 1.5e6)[
        0
    ]


def refracted_tangent(x, index):
    """Tangent in air of the projector's ray that reaches the table at (x, 0) through the slab."""
    tangents = np.linspace(-1, 1, 2_000_001)
    sine = tangents / np.hypot(1, tangents) / index
    reach = (HEIGHT - THICK) * tangents + THICK * sine / np.sqrt(1 - sine**2)
    return np.interp(x - 0.2, reach, tangents)


@pytest.mark.parametrize("index", [1.2, 1.49])
@pytest.mark.parametrize("x", [-0.05, 0.03])
def test_a_slab_shifts_the_column_as_refraction_says(index, x):
    expected = 512 + 640 * refracted_tangent(x, index)
    straight = 512 + 640 * (x - 0.2) / HEIGHT
    assert abs(expected - straight) > 1
    assert column_of(seen_through(WallOptics(refractive_index=index), x)) == pytest.approx(expected, abs=0.1)


def test_absorption_follows_the_way_through_the_slab():
    clear, dark = (seen_through(WallOptics(absorption_per_mm=a), 0.03)[0] for a in (0.0, 0.02))
    tangent = refracted_tangent(0.03, 1.49)
    sine = tangent / np.hypot(1, tangent) / 1.49
    way_mm = 1e3 * THICK * (1 + 1 / np.sqrt(1 - sine**2))
    assert dark / clear == pytest.approx(np.exp(-0.02 * way_mm), rel=0.03)


def test_a_clear_slab_costs_what_fresnel_says():
    bare = look(
        shapes.make_shapes([], [], Material(0.05), MATTE, None, 0.5, 0.15),
        SLAB_PROJECTOR, np.array([[0.03, 0.0, HEIGHT]]), np.array([[0.0, 0.0, -1.0]]),
    )[0]  # fmt: skip
    tangent = refracted_tangent(0.03, 1.49)
    cosine = 1 / np.hypot(1, tangent)
    inside = np.sqrt(1 - (1 - cosine**2) / 1.49**2)
    once = [
        (1 - optics.fresnel(c, 1.0, 1.49)) * (1 - optics.fresnel(k, 1.49, 1.0)) for c, k in ((cosine, inside), (1, 1))
    ]
    # Light between the faces and between slab and table adds a little; refraction changes the density by about 1 %.
    assert seen_through(CLEAR, 0.03)[0] / bare[0] == pytest.approx(once[0] * once[1], rel=0.05)


# Closed box: what the projector sends must be absorbed somewhere.

BOX_HALF = np.array([0.05, 0.05, 0.08])
FIELD = 0.45
BOX_PROJECTOR = Projector(
    np.array([0.0, 0.0, 0.075]), np.diag([1.0, -1.0, -1.0]), np.array([512 / FIELD, 512.0, FIELD, 1.0])
)


def absorbed_share(tube, wall, points=60_000):
    """Share of the projector's light that the walls of a closed box absorb, with a tube that absorbs nothing in it."""
    revolved = []
    if tube is not None:
        finishes = Finishes(opaque_body=Material(1.0))
        scene = Scene(load_rack("chen2023-soft-5x10"), np.eye(4), (tube,), finishes=finishes)
        revolved = parts.scene_parts(scene)[0]
    s = shapes.make_shapes(revolved, [BoxPart(np.eye(4), BOX_HALF, wall)], wall, wall, None, 0.0, 0.15)
    rng = np.random.default_rng(0)
    areas = 4 * np.prod(BOX_HALF) / BOX_HALF
    face, side = rng.choice(3, points, p=areas / areas.sum()), rng.choice([-1.0, 1.0], points)
    origins, directions = rng.uniform(-1, 1, (points, 3)) * BOX_HALF, np.zeros((points, 3))
    origins[np.arange(points), face] = side * (BOX_HALF[face] - 1e-5)
    directions[np.arange(points), face] = side
    sent = look(s, BOX_PROJECTOR, origins, directions, 4, 2e5, 3)[:, 0]
    irradiance = np.pi * sent.mean() / wall.albedo
    return irradiance * (1 - wall.albedo) * 2 * areas.sum() / (4 * np.arcsin(FIELD**2 / (1 + FIELD**2)))


@pytest.mark.parametrize(
    ("name", "plastic", "liquid"),
    [
        (None, None, None),
        ("chen2023-tube-1", WallOptics(refractive_index=1.49), None),
        ("chen2023-tube-1", WallOptics(scattering_per_mm=0.4), None),
        ("centrifuge-15ml-conical", WallOptics(scattering_per_mm=2.0), None),
        ("chen2023-tube-1", WallOptics(scattering_per_mm=0.4), Liquid(0.05, 1.33, 0.0)),
    ],
)
def test_energy_is_conserved_in_a_closed_white_box(name, plastic, liquid):
    tube = None
    if name is not None:
        model = load_tube(name).model_copy(update={"cap": None})
        pose = translation([0.005, 0.0, -0.07])
        tube = PlacedTube("A1", model, pose, optics=plastic, liquid=liquid)
    assert absorbed_share(tube, Material(0.5)) == pytest.approx(1.0, abs=0.02)


# Scenes.


def scene_with(plastic=None, tubes=("A2", "C5", "E9"), name="chen2023-tube-1", tilt=0.15, printed=None):
    """Upright tubes in a rack along the baseline, 0.65 m under a camera that is tilted about the image's x axis."""
    rack, model = load_rack("chen2023-soft-5x10"), load_tube(name)
    placed = tuple(PlacedTube(slot, model, tube_pose(rack, slot), optics=plastic) for slot in tubes)
    rotation = Rotation.from_euler("x", tilt).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    T_camera_rack = make_transform(rotation, np.array([0.0, 0.0, 0.65]) - rotation @ [0.0, 0.0, rack.height_m])
    return Scene(rack, T_camera_rack, placed, printed_cap=printed)


def test_threads_change_no_bit():
    camera = default_camera(96)
    one, two = (sensor.expose(scene_with(), camera, 5, effort=EFFORT, threads=n).sums for n in (1, 3))
    assert one.tobytes() == two.tobytes()
    assert one.tobytes() != sensor.expose(scene_with(), camera, 6, effort=EFFORT).sums.tobytes()


def blocks(image, size=12):
    h, w = (n // size * size for n in image.shape)
    return image[:h, :w].reshape(h // size, size, w // size, size).mean(axis=(1, 3))


def test_more_samples_change_no_mean():
    camera = default_camera(144)
    few, many = (
        sensor.expose(scene_with(), camera, 5 + side, effort=dataclasses.replace(EFFORT, side=side), threads=2)
        for side in (2, 5)
    )
    for channel, most in ((0, 0.02), (1, 0.06), (6, 0.02), (7, 0.02)):
        assert np.abs(blocks(few.sums[channel]) - blocks(many.sums[channel])).max() < most
    assert few.sums[0].mean() == pytest.approx(many.sums[0].mean(), rel=0.002)


def test_more_paths_where_it_is_noisy_lower_the_error():
    camera = default_camera(96)
    plain = sensor.expose(scene_with(), camera, 5, effort=EFFORT)
    more = sensor.expose(scene_with(), camera, 5, effort=dataclasses.replace(EFFORT, rounds=1, absolute_error=0.01))
    chosen = more.samples > plain.samples
    assert 0.005 < chosen.mean() < 0.5
    assert np.median(more.error[chosen]) < 0.8 * np.median(plain.error[chosen])
    assert more.sums[0].mean() == pytest.approx(plain.sums[0].mean(), rel=0.003)


def test_plastic_of_index_one_without_scatter_is_invisible():
    camera, effort = default_camera(144), dataclasses.replace(EFFORT, side=4, photons_per_mm2=15)
    plastic = WallOptics(refractive_index=1.0)
    with_tubes = sensor.expose(scene_with(plastic), camera, 5, effort=effort, threads=2).sums
    without = sensor.expose(scene_with(tubes=()), camera, 5, effort=effort, threads=2).sums
    real = sensor.expose(scene_with(), camera, 5, effort=effort, threads=2).sums
    for channel in (0, 6, 7):
        unseen = np.abs(blocks(with_tubes[channel], 4) - blocks(without[channel], 4)).max()
        seen = np.abs(blocks(real[channel], 4) - blocks(without[channel], 4)).max()
        assert unseen < 0.02
        assert seen > 3 * unseen


def test_a_symmetric_scene_has_a_symmetric_image():
    camera = default_camera(144)
    # Camera and projector lie in the plane y = 0; rows A and E mirror each other in it.
    scene = scene_with(tubes=("A3", "E3", "C7"), tilt=0.0)
    sums = sensor.expose(scene, camera, 5, effort=dataclasses.replace(EFFORT, side=3), threads=2).sums
    for channel in (0, 6, 7):
        image = blocks(sums[channel])
        assert np.abs(image - image[::-1]).max() < 0.02
    assert np.abs(blocks(sums[0]) - blocks(sums[0])[:, ::-1]).max() > 0.05


def test_an_opaque_scene_agrees_with_ray_casting():
    # A window of 240 pixels of the full camera: pixels are small against the rack's ribs.
    lens = CameraIntrinsics(240, 240, 1564.0, 1564.0, 119.5, 119.5)
    camera = dataclasses.replace(default_camera(), intrinsics=lens, noise=NO_NOISE)
    dark = Finishes(table=Material(0.2), rack=Material(0.3), printed_cap=Material(0.4))
    scene = scene_with(name="chen2023-tube-3", printed=load_cap("printed-square-16.7"), tubes=("B4", "C5", "C7"))
    scene = dataclasses.replace(scene, finishes=dark)
    rng = np.random.default_rng(0)
    light = sensor.render(scene, camera, rng, threads=2).cloud_m[..., 2]
    cast = raycast.render(scene, camera, rng).cloud_m[..., 2]
    local = transform_points(invert_transform(scene.T_camera_rack), lens.backproject(cast))
    on_top = scene.rack.top_signed_distance_m(local[..., :2]) < -6e-4
    top = on_top & (np.abs(local[..., 2] - scene.rack.height_m) < 3e-4)
    plates = np.abs(local[..., 2] - scene.rack.floor_m - 0.1055 - load_cap("printed-square-16.7").seat_mm * 1e-3) < 8e-3
    for surface in (top, plates):
        both = np.isfinite(light) & np.isfinite(cast) & surface
        off = (light - cast)[both]
        assert both.sum() > 1500
        assert abs(np.median(off)) < 3e-5
        assert np.percentile(np.abs(off), 90) < 3e-4
        assert (np.isfinite(light) == np.isfinite(cast))[surface].mean() > 0.97


def test_shapes_lie_where_the_meshes_lie():
    camera = default_camera(160)
    scene = scene_with(tilt=0.3, name="centrifuge-15ml-conical")
    rays = camera.intrinsics.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mesh = raycast.Surfaces(scene.parts()).cast(np.zeros_like(rays), rays).distance_m
    T = invert_transform(scene.T_camera_rack)
    origins, directions = np.tile(T[:3, 3], (len(rays), 1)), np.ascontiguousarray(rays @ T[:3, :3].T)
    distance, code = np.empty(len(rays)), np.empty(len(rays), dtype=np.int64)
    first_hits(shapes.shapes_of(scene), origins, directions, distance, code, code.copy(), code.copy())
    close = np.abs(distance - mesh) < 2e-4
    assert (code > 0).all()
    assert close.mean() > 0.995


# Light map.


def test_texels_hold_the_area_of_what_they_stand_for():
    scene = scene_with()
    s = shapes.shapes_of(scene)
    m = light_map.make_light_map(s)
    area = np.add.reduceat(m.light[:, 7].astype(float), m.patches[:, 0])
    rack, slot = scene.rack, scene.rack.slot("A1")
    opening = slot.half_size_m.prod() * 4 - (4 - np.pi) * 2e-3**2
    assert area[1] == pytest.approx(rack.outline_m.prod() - 50 * opening, rel=5e-3)
    assert area[6:10].sum() == pytest.approx((8 * 8.25e-3 - (8 - 2 * np.pi) * 2e-3) * rack.depth_m, rel=1e-3)
    assert area[10] == pytest.approx(opening, rel=5e-3)
    walls = area[-len(s.solids) :]
    model = scene.tubes[0].model
    outer, inner = (revolved_volume(p) for p in (model.outer_profile_m(1e-5)[:-1], model.cavity_profile_m(1e-5)[::-1]))
    np.testing.assert_allclose(walls, outer - inner, rtol=5e-3)


def revolved_volume(profile):
    z, r = profile.T
    return np.pi * np.sum(np.diff(z) * (r[:-1] ** 2 + r[:-1] * r[1:] + r[1:] ** 2) / 3)


# Optics.


def test_fresnel_at_normal_incidence_brewster_and_total_reflection():
    assert optics.fresnel(1.0, 1.0, 1.5) == pytest.approx(0.04)
    across = (
        (np.cos(np.arctan(1.5)) - 1.5 * np.sin(np.arctan(1.5)))
        / (np.cos(np.arctan(1.5)) + 1.5 * np.sin(np.arctan(1.5)))
    ) ** 2
    assert optics.fresnel(np.cos(np.arctan(1.5)), 1.0, 1.5) == pytest.approx(across / 2)
    assert optics.fresnel(0.5, 1.5, 1.0) == 1.0
    assert optics.fresnel(0.3, 1.0, 1.0) == pytest.approx(0.0)


def test_refraction_obeys_snell_and_reverses():
    d = np.array([np.sin(0.7), 0.0, -np.cos(0.7)])
    x, y, z = optics.refracted(*d, 0.0, 0.0, 1.0, np.cos(0.7), 1 / 1.49)
    assert (np.hypot(x, y), y) == (pytest.approx(np.sin(0.7) / 1.49), 0.0)
    back = optics.refracted(-x, -y, -z, 0.0, 0.0, -1.0, -z, 1.49)
    np.testing.assert_allclose(back, -d, atol=1e-12)


@pytest.mark.parametrize("alpha", [0.1, 0.4, 0.9])
def test_sampled_gloss_is_the_gloss_that_is_evaluated(alpha):
    state = np.array([3], dtype=np.uint64)
    out = np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    drawn = np.mean([optics.ggx_direction(state, *out, 0.0, 0.0, 1.0, alpha, 1.5)[3] for _ in range(20_000)])
    cosine = (np.arange(400) + 0.5) / 400
    phi = (np.arange(400) + 0.5) / 400 * 2 * np.pi
    c, p = np.meshgrid(cosine, phi)
    sine = np.sqrt(1 - c**2)
    cells = zip((sine * np.cos(p)).ravel(), (sine * np.sin(p)).ravel(), c.ravel(), strict=True)
    summed = sum(optics.ggx_towards(*out, x, y, z, 0.0, 0.0, 1.0, alpha, 1.5) * z for x, y, z in cells)
    assert drawn == pytest.approx(summed * 2 * np.pi / c.size, rel=0.03)
    a, b = (0.3, 0.1, np.sqrt(0.9)), (-0.5, 0.2, np.sqrt(0.71))
    one = optics.ggx_towards(*a, *b, 0.0, 0.0, 1.0, alpha, 1.5)
    assert optics.ggx_towards(*b, *a, 0.0, 0.0, 1.0, alpha, 1.5) == pytest.approx(one)


def test_random_numbers_are_uniform_and_streams_differ():
    state = np.array([0], dtype=np.uint64)
    optics.start(state, 1, 2, 3)
    drawn = np.array([optics.uniform(state) for _ in range(20_000)])
    assert (drawn >= 0).all()
    assert (drawn < 1).all()
    assert np.histogram(drawn, 10, (0, 1))[0] == pytest.approx(np.full(10, 2000), abs=200)
    firsts = set()
    for seed, stream, number in np.ndindex(4, 8, 64):
        optics.start(state, seed, stream, number)
        firsts.add(optics.uniform(state))
    assert len(firsts) == 4 * 8 * 64


def test_the_projector_tags_points_as_the_camera_decodes_them():
    camera = default_camera(64)
    scene = scene_with(tilt=0.2)
    projector = projector_of(camera, scene.T_camera_rack)
    points = np.array([[0.02, 0.01, 0.05], [-0.05, -0.03, 0.0]])
    expected = camera.column(transform_points(scene.T_camera_rack, points))
    np.testing.assert_allclose([towards(projector, *p)[4] for p in points], expected, atol=1e-9)
