"""Ray tracing of a few simple bodies with soft shadows and mirrors, for the built-in captures.

A body is a unit shape in its own space, x_body = A x_world + b. A ray o + t d becomes (A o + b) + t (A d) there, with
the same t. Unit shapes: the sphere |x| = 1; the cube max |x_i| = 1, seen from outside or from inside; the torus
around z, of radii 1 and TUBE, which is intersected by sphere tracing of its distance function

    f(x) = |(|x_xy| − 1, x_z)| − TUBE

in steps of f (A must then be a rotation and a uniform scale); and the blob, a sphere with three lobes of the height s,

    f(x) = |x| − 1 − s q(x) / |x|³,   q(x) = x₁³ − 3 x₁ x₂²,

in steps of f / 2, because |∇f| < 2 near it for |s| ≤ ¼. A normal n_body becomes Aᵀ n_body. Shading is Lambert's and
Blinn's, with a hemispherical ambient light. A mirror of the fraction m shows (1 − m) of its own shading and m times its
first colour times the shading of what the reflected ray hits.

The light is a parallelogram: every sample of a pixel uses its own point of it, at (2u − 1, 2v − 1) half axes. All
pixels use the same samples, which would show as rings in soft shadows; so (u, v) is shifted, modulo 1, by interleaved
gradient noise (Jimenez 2014), whose values differ strongly between neighbouring pixels:

    noise(x, y) = frac(52.9829189 · frac(0.06711056 x + 0.00583715 y)).

The images are the same bits on every CPU: operations are only those that IEEE 754 rounds exactly (so no sine and no
power of the C library), in the order of the source (no fused multiply-add, no instructions of a certain CPU).
"""

import warp as wp

wp.set_module_options({"fuse_fp": False, "cpu_compiler_flags": ""})

SPHERE = wp.constant(0)
CUBE = wp.constant(1)
TORUS = wp.constant(2)
BLOB = wp.constant(3)

TUBE = wp.constant(0.3)
MAX_TRACING_STEPS = wp.constant(160)
HIT_DISTANCE = wp.constant(2.0e-4)
FAR = wp.constant(1.0e6)
SHADOW_OFFSET = wp.constant(1.0e-3)
"""Distance of the start of shadow rays from their surface [world units], so that it does not shadow itself."""

AMBIENT_UP = wp.constant(0.42)
AMBIENT_DOWN = wp.constant(0.24)
DIFFUSE = wp.constant(0.72)
TWO_PI = wp.constant(6.283185307179586)
HALF_PI = wp.constant(1.5707963267948966)


@wp.func
def torus_distance(p: wp.vec3) -> float:
    around = wp.sqrt(p[0] * p[0] + p[1] * p[1]) - 1.0
    return wp.sqrt(around * around + p[2] * p[2]) - TUBE


@wp.func
def hit_sphere(o: wp.vec3, d: wp.vec3) -> float:
    """Smallest t > 0 of a hit from outside, FAR without a hit, as for every shape."""
    a = wp.dot(d, d)
    b = wp.dot(o, d)
    root = b * b - a * (wp.dot(o, o) - 1.0)
    if root < 0.0:
        return FAR
    t = (-b - wp.sqrt(root)) / a
    if t > 0.0:
        return t
    return FAR


@wp.func
def hit_cube(o: wp.vec3, d: wp.vec3) -> float:
    enter = -FAR
    leave = FAR
    for axis in range(3):
        if wp.abs(d[axis]) > 1.0e-9:
            a = (-1.0 - o[axis]) / d[axis]
            b = (1.0 - o[axis]) / d[axis]
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
        elif wp.abs(o[axis]) > 1.0:
            return FAR
    if enter > leave:
        return FAR
    if enter > 0.0:
        return enter
    if leave > 0.0:
        return leave
    return FAR


@wp.func
def blob_distance(p: wp.vec3, bulge: float) -> float:
    radius = wp.sqrt(wp.dot(p, p))
    lobes = p[0] * (p[0] * p[0] - 3.0 * p[1] * p[1])
    return radius - 1.0 - bulge * lobes / wp.max(radius * radius * radius, 1.0e-6)  # rays may pass through the centre


@wp.func
def hit_by_tracing(shape: int, bulge: float, o: wp.vec3, d: wp.vec3) -> float:
    """Sphere tracing of a torus or a blob, of the part of the ray inside its bounding sphere."""
    reach = 1.0 + TUBE
    pace = float(1.0)
    if shape == BLOB:
        reach = 1.0 + wp.abs(bulge)
        pace = 0.5
    a = wp.dot(d, d)
    b = wp.dot(o, d)
    root = b * b - a * (wp.dot(o, o) - reach * reach)
    if root < 0.0:
        return FAR
    t = wp.max((-b - wp.sqrt(root)) / a, 0.0)
    leave = (-b + wp.sqrt(root)) / a
    speed = wp.sqrt(a)
    for _step in range(MAX_TRACING_STEPS):
        if t > leave:
            return FAR
        distance = float(0.0)
        if shape == BLOB:
            distance = blob_distance(o + t * d, bulge)
        else:
            distance = torus_distance(o + t * d)
        if distance < HIT_DISTANCE:
            return t
        t += pace * distance / speed
    return FAR


@wp.func
def into_body(bodies: wp.array3d[float], body: int, p: wp.vec3, w: float) -> wp.vec3:
    """A p + w b for the transform (A, b) of a body."""
    x = bodies[body, 0, 0] * p[0] + bodies[body, 0, 1] * p[1] + bodies[body, 0, 2] * p[2] + bodies[body, 0, 3] * w
    y = bodies[body, 1, 0] * p[0] + bodies[body, 1, 1] * p[1] + bodies[body, 1, 2] * p[2] + bodies[body, 1, 3] * w
    z = bodies[body, 2, 0] * p[0] + bodies[body, 2, 1] * p[1] + bodies[body, 2, 2] * p[2] + bodies[body, 2, 3] * w
    return wp.vec3(x, y, z)


@wp.func
def hit_body(shape: int, bulge: float, o: wp.vec3, d: wp.vec3) -> float:
    if shape == SPHERE:
        return hit_sphere(o, d)
    if shape == CUBE:
        return hit_cube(o, d)
    return hit_by_tracing(shape, bulge, o, d)


@wp.func
def body_normal(shape: int, bulge: float, p: wp.vec3) -> wp.vec3:
    """Outward normal, of any length, at a point of a unit shape."""
    if shape == SPHERE:
        return p
    if shape == CUBE:
        x = wp.abs(p[0])
        y = wp.abs(p[1])
        z = wp.abs(p[2])
        if x > y and x > z:
            return wp.vec3(p[0], 0.0, 0.0)
        if y > z:
            return wp.vec3(0.0, p[1], 0.0)
        return wp.vec3(0.0, 0.0, p[2])
    if shape == BLOB:
        square = wp.dot(p, p)
        radius = wp.sqrt(square)
        lobes = p[0] * (p[0] * p[0] - 3.0 * p[1] * p[1])
        slope = wp.vec3(3.0 * (p[0] * p[0] - p[1] * p[1]), -6.0 * p[0] * p[1], 0.0) - (3.0 * lobes / square) * p
        return p / radius - (bulge / (square * radius)) * slope
    around = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    return wp.vec3(p[0] - p[0] / around, p[1] - p[1] / around, p[2])


@wp.func
def sine(x: float) -> float:
    """Sine by its Taylor series after reduction to [−π/2, π/2]; the error is below 1e-6 for |x| < 100."""
    r = x - TWO_PI * wp.floor(x / TWO_PI + 0.5)
    if r > HALF_PI:
        r = 0.5 * TWO_PI - r
    if r < -HALF_PI:
        r = -0.5 * TWO_PI - r
    s = r * r
    tail = -1.0 / 5040.0 + s * (1.0 / 362880.0 - s / 39916800.0)
    return r * (1.0 + s * (-1.0 / 6.0 + s * (1.0 / 120.0 + s * tail)))


@wp.func
def power40(x: float) -> float:
    x2 = x * x
    x4 = x2 * x2
    x8 = x4 * x4
    x16 = x8 * x8
    return x16 * x16 * x8


@wp.func
def soft_checkerboard(p: wp.vec3, frequency: float) -> float:
    """A checkerboard in [0, 1] with soft edges and the given angular frequency."""
    wave = sine(frequency * p[0] + 0.4) * sine(frequency * p[1] + 0.9) * sine(frequency * p[2] + 1.3)
    return 0.5 + 0.5 * wave / (wp.abs(wave) + 0.06)


@wp.func
def noise(x: float, y: float) -> float:
    inner = 0.06711056 * x + 0.00583715 * y
    outer = 52.9829189 * (inner - wp.floor(inner))
    return outer - wp.floor(outer)


@wp.func
def lamp_point(lamp: wp.array2d[float], u: float, v: float) -> wp.vec3:
    """Point of the lamp at (u, v) modulo 1."""
    a = 2.0 * (u - wp.floor(u)) - 1.0
    b = 2.0 * (v - wp.floor(v)) - 1.0
    center = wp.vec3(lamp[0, 0], lamp[0, 1], lamp[0, 2])
    return center + a * wp.vec3(lamp[1, 0], lamp[1, 1], lamp[1, 2]) + b * wp.vec3(lamp[2, 0], lamp[2, 1], lamp[2, 2])


@wp.func
def nearest_body(
    shapes: wp.array[int], bodies: wp.array3d[float], materials: wp.array[wp.vec3], o: wp.vec3, d: wp.vec3
):
    """(t, body) of the first hit; (FAR, −1) without one."""
    nearest = float(FAR)
    body = int(-1)
    for k in range(shapes.shape[0]):
        t = hit_body(shapes[k], materials[k][2], into_body(bodies, k, o, 1.0), into_body(bodies, k, d, 0.0))
        if t < nearest:
            nearest = t
            body = k
    return nearest, body


@wp.func
def is_blocked(
    shapes: wp.array[int], bodies: wp.array3d[float], materials: wp.array[wp.vec3], start: wp.vec3, to_light: wp.vec3
) -> bool:
    for k in range(shapes.shape[0]):
        o = into_body(bodies, k, start, 1.0)
        if hit_body(shapes[k], materials[k][2], o, into_body(bodies, k, to_light, 0.0)) < 1.0:
            return True
    return False


@wp.func
def world_normal(
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    materials: wp.array[wp.vec3],
    body: int,
    point: wp.vec3,
    view: wp.vec3,
) -> wp.vec3:
    """Normal at a point of a body, on the side that is seen from the direction ``view``: Aᵀ n, normalised."""
    n = body_normal(shapes[body], materials[body][2], into_body(bodies, body, point, 1.0))
    x = bodies[body, 0, 0] * n[0] + bodies[body, 1, 0] * n[1] + bodies[body, 2, 0] * n[2]
    y = bodies[body, 0, 1] * n[0] + bodies[body, 1, 1] * n[1] + bodies[body, 2, 1] * n[2]
    z = bodies[body, 0, 2] * n[0] + bodies[body, 1, 2] * n[1] + bodies[body, 2, 2] * n[2]
    normal = wp.normalize(wp.vec3(x, y, z))
    if wp.dot(normal, view) < 0.0:
        normal = -normal  # a cube may be seen from inside
    return normal


@wp.func
def shade(
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    colors: wp.array2d[wp.vec3],
    frequencies: wp.array[float],
    materials: wp.array[wp.vec3],
    body: int,
    point: wp.vec3,
    view: wp.vec3,
    normal: wp.vec3,
    source: wp.vec3,
) -> wp.vec3:
    """Colour of a body's point, seen from the direction ``view`` and lit from ``source``, without what it mirrors."""
    start = point + SHADOW_OFFSET * normal
    to_light = source - start
    light = wp.normalize(to_light)
    diffuse = wp.max(wp.dot(normal, light), 0.0)
    if diffuse > 0.0 and is_blocked(shapes, bodies, materials, start, to_light):
        diffuse = 0.0
    checks = soft_checkerboard(into_body(bodies, body, point, 1.0), frequencies[body])
    color = checks * colors[body, 0] + (1.0 - checks) * colors[body, 1]
    ambient = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * (0.5 + 0.5 * normal[2])
    gloss = power40(wp.max(wp.dot(normal, wp.normalize(light + view)), 0.0))
    return (ambient + DIFFUSE * diffuse) * color + wp.vec3(materials[body][0] * gloss * diffuse)


@wp.func
def radiance(
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    colors: wp.array2d[wp.vec3],
    frequencies: wp.array[float],
    materials: wp.array[wp.vec3],
    body: int,
    point: wp.vec3,
    direction: wp.vec3,
    source: wp.vec3,
) -> wp.vec3:
    """Colour of a body's point, hit by a ray of the given direction, with what it mirrors."""
    view = -wp.normalize(direction)
    normal = world_normal(shapes, bodies, materials, body, point, view)
    color = shade(shapes, bodies, colors, frequencies, materials, body, point, view, normal, source)
    mirror = materials[body][1]
    if mirror > 0.0:
        start = point + SHADOW_OFFSET * normal
        reflected = 2.0 * wp.dot(normal, view) * normal - view
        t, other = nearest_body(shapes, bodies, materials, start, reflected)
        color = (1.0 - mirror) * color
        if other >= 0:
            seen = start + t * reflected
            n = world_normal(shapes, bodies, materials, other, seen, -reflected)
            image = shade(shapes, bodies, colors, frequencies, materials, other, seen, -reflected, n, source)
            color += mirror * wp.cw_mul(colors[body, 0], image)
    return color


@wp.kernel(enable_backward=False)
def raytrace_fwd(
    first: int,
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    colors: wp.array2d[wp.vec3],
    frequencies: wp.array[float],
    materials: wp.array[wp.vec3],
    lamp: wp.array2d[float],
    samples: wp.array[wp.vec4],
    viewmat: wp.array2d[float],
    K: wp.array2d[float],
    width: int,
    image: wp.array[wp.vec3],
    depth: wp.array[float],
    hits: wp.array[int],
):
    pixel = first + wp.tid()
    column = float(pixel % width)
    row = float(pixel / width)
    right = wp.vec3(viewmat[0, 0], viewmat[0, 1], viewmat[0, 2])
    down = wp.vec3(viewmat[1, 0], viewmat[1, 1], viewmat[1, 2])
    forward = wp.vec3(viewmat[2, 0], viewmat[2, 1], viewmat[2, 2])
    origin = -(right * viewmat[0, 3] + down * viewmat[1, 3] + forward * viewmat[2, 3])
    shift_u = noise(column, row)
    shift_v = noise(row, column)
    total = wp.vec3(0.0)
    num_samples = samples.shape[0]
    # Sample −1 passes through the pixel's centre and gives depth and body; the others give the colour.
    for index in range(-1, num_samples):
        sample = wp.vec4(0.5, 0.5, 0.0, 0.0)
        if index >= 0:
            sample = samples[index]
        u = (column + sample[0] - K[0, 2]) / K[0, 0]
        v = (row + sample[1] - K[1, 2]) / K[1, 1]
        direction = right * u + down * v + forward  # so t is the depth
        t, body = nearest_body(shapes, bodies, materials, origin, direction)
        if index < 0:
            depth[pixel] = t
            hits[pixel] = body
        elif body >= 0:
            source = lamp_point(lamp, sample[2] + shift_u, sample[3] + shift_v)
            point = origin + t * direction
            total += radiance(shapes, bodies, colors, frequencies, materials, body, point, direction, source)
    image[pixel] = total / float(num_samples)
