"""Ray tracing of a few simple bodies with soft shadows, for the synthetic scene.

A body is a unit shape in its own space, x_body = A x_world + b. A ray o + t d becomes (A o + b) + t (A d) there, with
the same t. Unit shapes: the sphere |x| = 1; the cube max |x_i| = 1, seen from outside or from inside; the torus
around z, of radii 1 and TUBE, which is intersected by sphere tracing of its distance function

    f(x) = |(|x_xy| − 1, x_z)| − TUBE

in steps of f (A must then be a rotation and a uniform scale). A normal n_body becomes Aᵀ n_body. Shading is Lambert's
and Blinn's, with a hemispherical ambient light.

The light is a parallelogram: every sample of a pixel uses its own point of it, at (2u − 1, 2v − 1) half axes. All
pixels use the same samples, which would show as rings in soft shadows; so (u, v) is shifted, modulo 1, by interleaved
gradient noise (Jimenez 2014), whose values differ strongly between neighbouring pixels:

    noise(x, y) = frac(52.9829189 · frac(0.06711056 x + 0.00583715 y)).
"""

import warp as wp

SPHERE = wp.constant(0)
CUBE = wp.constant(1)
TORUS = wp.constant(2)

TUBE = wp.constant(0.3)
MAX_TRACING_STEPS = wp.constant(160)
HIT_DISTANCE = wp.constant(2.0e-4)
FAR = wp.constant(1.0e6)
SHADOW_OFFSET = wp.constant(1.0e-3)
"""Distance of the start of shadow rays from their surface [world units], so that it does not shadow itself."""

AMBIENT_UP = wp.constant(0.42)
AMBIENT_DOWN = wp.constant(0.24)
DIFFUSE = wp.constant(0.72)
SHINE = wp.constant(0.18)
GLOSS = wp.constant(40.0)


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
def hit_torus(o: wp.vec3, d: wp.vec3) -> float:
    # Only the part of the ray inside the bounding sphere of the torus is traced.
    a = wp.dot(d, d)
    b = wp.dot(o, d)
    root = b * b - a * (wp.dot(o, o) - (1.0 + TUBE) * (1.0 + TUBE))
    if root < 0.0:
        return FAR
    t = wp.max((-b - wp.sqrt(root)) / a, 0.0)
    leave = (-b + wp.sqrt(root)) / a
    speed = wp.sqrt(a)
    for _step in range(MAX_TRACING_STEPS):
        if t > leave:
            return FAR
        distance = torus_distance(o + t * d)
        if distance < HIT_DISTANCE:
            return t
        t += distance / speed
    return FAR


@wp.func
def into_body(bodies: wp.array3d[float], body: int, p: wp.vec3, w: float) -> wp.vec3:
    """A p + w b for the transform (A, b) of a body."""
    x = bodies[body, 0, 0] * p[0] + bodies[body, 0, 1] * p[1] + bodies[body, 0, 2] * p[2] + bodies[body, 0, 3] * w
    y = bodies[body, 1, 0] * p[0] + bodies[body, 1, 1] * p[1] + bodies[body, 1, 2] * p[2] + bodies[body, 1, 3] * w
    z = bodies[body, 2, 0] * p[0] + bodies[body, 2, 1] * p[1] + bodies[body, 2, 2] * p[2] + bodies[body, 2, 3] * w
    return wp.vec3(x, y, z)


@wp.func
def hit_body(shape: int, o: wp.vec3, d: wp.vec3) -> float:
    if shape == SPHERE:
        return hit_sphere(o, d)
    if shape == CUBE:
        return hit_cube(o, d)
    return hit_torus(o, d)


@wp.func
def body_normal(shape: int, p: wp.vec3) -> wp.vec3:
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
    around = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    return wp.vec3(p[0] - p[0] / around, p[1] - p[1] / around, p[2])


@wp.func
def soft_checkerboard(p: wp.vec3, frequency: float) -> float:
    """A checkerboard in [0, 1] with soft edges and the given angular frequency."""
    wave = wp.sin(frequency * p[0] + 0.4) * wp.sin(frequency * p[1] + 0.9) * wp.sin(frequency * p[2] + 1.3)
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
def nearest_body(shapes: wp.array[int], bodies: wp.array3d[float], o: wp.vec3, d: wp.vec3):
    """(t, body) of the first hit; (FAR, −1) without one."""
    nearest = float(FAR)
    body = int(-1)
    for k in range(shapes.shape[0]):
        t = hit_body(shapes[k], into_body(bodies, k, o, 1.0), into_body(bodies, k, d, 0.0))
        if t < nearest:
            nearest = t
            body = k
    return nearest, body


@wp.func
def is_blocked(shapes: wp.array[int], bodies: wp.array3d[float], start: wp.vec3, to_light: wp.vec3) -> bool:
    for k in range(shapes.shape[0]):
        if hit_body(shapes[k], into_body(bodies, k, start, 1.0), into_body(bodies, k, to_light, 0.0)) < 1.0:
            return True
    return False


@wp.func
def world_normal(bodies: wp.array3d[float], body: int, n: wp.vec3) -> wp.vec3:
    """Aᵀ n for the transform (A, b) of a body, normalised."""
    x = bodies[body, 0, 0] * n[0] + bodies[body, 1, 0] * n[1] + bodies[body, 2, 0] * n[2]
    y = bodies[body, 0, 1] * n[0] + bodies[body, 1, 1] * n[1] + bodies[body, 2, 1] * n[2]
    z = bodies[body, 0, 2] * n[0] + bodies[body, 1, 2] * n[1] + bodies[body, 2, 2] * n[2]
    return wp.normalize(wp.vec3(x, y, z))


@wp.func
def shade(
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    colors: wp.array2d[wp.vec3],
    frequencies: wp.array[float],
    body: int,
    point: wp.vec3,
    view: wp.vec3,
    source: wp.vec3,
) -> wp.vec3:
    """Colour of a body's point, seen from the direction ``view`` and lit from ``source``."""
    local = into_body(bodies, body, point, 1.0)
    normal = world_normal(bodies, body, body_normal(shapes[body], local))
    if wp.dot(normal, view) < 0.0:
        normal = -normal  # a cube may be seen from inside
    start = point + SHADOW_OFFSET * normal
    to_light = source - start
    light = wp.normalize(to_light)
    diffuse = wp.max(wp.dot(normal, light), 0.0)
    if diffuse > 0.0 and is_blocked(shapes, bodies, start, to_light):
        diffuse = 0.0
    checks = soft_checkerboard(local, frequencies[body])
    color = checks * colors[body, 0] + (1.0 - checks) * colors[body, 1]
    ambient = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * (0.5 + 0.5 * normal[2])
    gloss = wp.pow(wp.max(wp.dot(normal, wp.normalize(light + view)), 0.0), GLOSS)
    return (ambient + DIFFUSE * diffuse) * color + wp.vec3(SHINE * gloss * diffuse)


@wp.kernel(enable_backward=False)
def raytrace_fwd(
    first: int,
    shapes: wp.array[int],
    bodies: wp.array3d[float],
    colors: wp.array2d[wp.vec3],
    frequencies: wp.array[float],
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
        t, body = nearest_body(shapes, bodies, origin, direction)
        if index < 0:
            depth[pixel] = t
            hits[pixel] = body
        elif body >= 0:
            source = lamp_point(lamp, sample[2] + shift_u, sample[3] + shift_v)
            view = -wp.normalize(direction)
            total += shade(shapes, bodies, colors, frequencies, body, origin + t * direction, view, source)
    image[pixel] = total / float(num_samples)
