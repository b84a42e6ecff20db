// The skin of a hand: a smooth solid about given bones, and its surface as triangles.
//
// All in the frame of the wrist joint (WebXR axes: -z to the fingers, +y out of the back of the hand), in metres. The
// solid is a signed distance: round cones along the finger bones, curved slabs between neighbouring metacarpals, melted
// together where the palm meets fingers, thumb and forearm, so that the surface is one piece.

const CELL_M = 0.0026; // of the grid; vertices are then put exactly on the surface
const BLOCK = 5; // cells; blocks that the surface does not pass are not sampled
const WEB = 0.3; // of the first finger bone: so far the skin between two fingers reaches

const add = (a, b, t = 1) => [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const mix = (a, b, t) => a + (b - a) * t;
const clamp01 = (t) => (t < 0 ? 0 : t > 1 ? 1 : t);

/** Distance [m] from `p` to a cone with round ends: `a`, `b` are its ends, `ra`, `rb` its radii there. */
export function coneDistance(p, a, b, ra, rb) {
  const dx = b[0] - a[0], dy = b[1] - a[1], dz = b[2] - a[2];
  const px = p[0] - a[0], py = p[1] - a[1], pz = p[2] - a[2];
  const t = clamp01((px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz + 1e-12));
  return Math.hypot(px - t * dx, py - t * dy, pz - t * dz) - mix(ra, rb, t);
}

/** A part of the solid, with a ball about it, so that far parts need not be measured. */
function part(corners, measure) {
  const middle = [0, 1, 2].map((i) => corners.reduce((sum, c) => sum + c[i], 0) / corners.length);
  const reach = Math.max(...corners.map((c) => Math.hypot(...sub(c, middle).slice(0, 3)) + c[3]));
  return { middle, reach, measure };
}

/** A lower bound of the distance to a part [m]. */
const atLeast = (p, { middle, reach }) => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]) - reach;

/**
 * A curved slab between the edges a0-a1 and b0-b1 ([x, y, z, radius] each).
 * `thin`: by how much of its thickness it is thinner half way between the edges.
 */
function slab(a0, a1, b0, b1, thin) {
  return part([a0, a1, b0, b1], (p) => {
    let s = 0.5, t = 0.5;
    for (let turn = 0; turn < 3; turn++) {
      t = nearest(p, a0, b0, a1, b1, s);
      s = nearest(p, a0, a1, b0, b1, t);
    }
    const on = (i) => mix(mix(a0[i], a1[i], t), mix(b0[i], b1[i], t), s);
    return Math.hypot(p[0] - on(0), p[1] - on(1), p[2] - on(2)) - on(3) * (1 - 4 * thin * s * (1 - s));
  });
}

/** Where on the segment mix(a, b, u) - mix(c, d, u) the point is nearest, 0...1. */
function nearest(p, a, b, c, d, u) {
  const x = mix(a[0], b[0], u), y = mix(a[1], b[1], u), z = mix(a[2], b[2], u);
  const dx = mix(c[0], d[0], u) - x, dy = mix(c[1], d[1], u) - y, dz = mix(c[2], d[2], u) - z;
  return clamp01(((p[0] - x) * dx + (p[1] - y) * dy + (p[2] - z) * dz) / (dx * dx + dy * dy + dz * dz + 1e-12));
}

/** The lesser of two distances, rounded over where they differ by less than k [m]. */
function melt(a, b, k) {
  const h = Math.max(k - Math.abs(a - b), 0) / k;
  return Math.min(a, b) - 0.25 * h * h * k;
}

/**
 * The solid as a function point -> distance [m], negative inside.
 * `at[j]`: bind positions of the 25 joints, `radius[j]`; `side`: +1 right hand, -1 left hand.
 */
export function handSolid(at, radius, side) {
  const ball = (j, share = 1, shift = [0, 0, 0]) => [...add(at[j], shift), share * radius[j]];
  const slabs = [], webs = [];
  for (const [a, b] of [[5, 10], [10, 15], [15, 20]]) {
    slabs.push(slab(ball(a), ball(a + 1), ball(b), ball(b + 1), 0));
    const low = [0, -0.25 * radius[a + 1], 0];
    const end = (f) => [...add(add(at[f + 1], sub(at[f + 2], at[f + 1]), WEB), low), 0.7 * radius[f + 1]];
    webs.push(slab(ball(a + 1, 0.8, low), end(a), ball(b + 1, 0.8, low), end(b), 0.35));
  }
  // Carpals: from the wrist's two edges into the metacarpals; behind them a piece of the forearm.
  const wrist = (x, z, share = 0.6) => [side * x * radius[0], -0.003, z, share * radius[0]];
  const into = (j, t) => [...at[j].map((x, i) => mix(x, at[j + 1][i], t)), 0.97 * mix(radius[j], radius[j + 1], t)];
  const arm = [
    slab(wrist(-0.46, 0), into(5, 0.15), wrist(0.46, 0), into(20, 0.15), 0),
    slab(wrist(-0.46, 0), wrist(-0.56, 0.05, 0.68), wrist(0.46, 0), wrist(0.56, 0.05, 0.68), 0),
  ];
  // The ball of the thumb, and the skin from its bone to the index finger's.
  const root = at[5].map((x, i) => mix(x, at[6][i], 0.62));
  const crook = [...root, 0.82 * mix(radius[5], radius[6], 0.62)];
  const ballOfThumb = [
    slab(ball(1, 0.95), ball(2, 1.02), ball(5, 0.95), crook, 0.3),
    slab(wrist(-0.3, 0.004), ball(1, 0.95), ball(10), ball(5), 0),
  ];
  const cone = (a, b) => part([ball(a), ball(b)], (p) => coneDistance(p, at[a], at[b], radius[a], radius[b]));
  const cones = (first, last) => Array.from({ length: last - first }, (_, k) => cone(first + k, first + k + 1));
  const thumbBones = cones(1, 4), fingerBones = [[6, 9], [11, 14], [16, 19], [21, 24]].flatMap(([a, b]) => cones(a, b));
  return (p) => {
    const palm = melt(least(p, slabs), least(p, arm), 0.016);
    const thumb = melt(least(p, thumbBones), least(p, ballOfThumb), 0.008);
    const fingers = melt(least(p, fingerBones), least(p, webs), 0.004);
    return melt(melt(palm, fingers, 0.005), thumb, 0.014);
  };
}

/** Distance [m] to the nearest of some parts. */
function least(p, parts) {
  let distance = 1;
  for (const one of parts) if (atLeast(p, one) < distance) distance = Math.min(distance, one.measure(p));
  return distance;
}

function gradient(solid, p, h = 2e-4) {
  const g = [0, 1, 2].map((i) => {
    const q = [...p], r = [...p];
    q[i] += h;
    r[i] -= h;
    return (solid(q) - solid(r)) / (2 * h);
  });
  const length = Math.hypot(...g) || 1;
  return { way: g.map((x) => x / length), length };
}

/** Distances on a grid about `low`...`high`; far from the surface one value stands for a block. */
function sampled(solid, low, high) {
  const size = [0, 1, 2].map((i) => Math.ceil((high[i] - low[i]) / CELL_M / BLOCK) * BLOCK + 1);
  const [nx, ny, nz] = size, values = new Float32Array(nx * ny * nz).fill(1);
  const reach = BLOCK * CELL_M * 0.9 + 0.006; // half a block's diagonal, and what melting adds
  const point = (x, y, z) => [low[0] + x * CELL_M, low[1] + y * CELL_M, low[2] + z * CELL_M];
  for (let bz = 0; bz < nz - 1; bz += BLOCK)
    for (let by = 0; by < ny - 1; by += BLOCK)
      for (let bx = 0; bx < nx - 1; bx += BLOCK) {
        const middle = solid(point(bx + BLOCK / 2, by + BLOCK / 2, bz + BLOCK / 2));
        const near = Math.abs(middle) < reach;
        for (let z = bz; z <= bz + BLOCK; z++)
          for (let y = by; y <= by + BLOCK; y++)
            for (let x = bx; x <= bx + BLOCK; x++) {
              const i = x + nx * (y + ny * z);
              if (near) values[i] = values[i] === 1 || Math.abs(values[i]) > 0.9 ? solid(point(x, y, z)) : values[i];
              else if (values[i] === 1) values[i] = middle < 0 ? -0.99 : 1;
            }
      }
  return { size, values, point };
}

/** The surface of a solid within a box: positions, normals (flat arrays) and triangles, by naive surface nets. */
export function surfaceOf(solid, low, high) {
  const { size: [nx, ny, nz], values, point } = sampled(solid, low, high);
  const step = [1, nx, nx * ny], vertexOf = new Int32Array(values.length).fill(-1);
  const positions = [], normals = [], triangles = [];
  for (let z = 0; z < nz - 1; z++)
    for (let y = 0; y < ny - 1; y++)
      for (let x = 0; x < nx - 1; x++) {
        const cell = x + nx * (y + ny * z);
        const crossing = cellVertex(values, cell, step);
        if (crossing === null) continue;
        let p = point(x + crossing[0], y + crossing[1], z + crossing[2]);
        for (let turn = 0; turn < 2; turn++) {
          const { way, length } = gradient(solid, p);
          p = add(p, way, -Math.max(-CELL_M, Math.min(CELL_M, solid(p) / Math.max(length, 0.3))));
        }
        vertexOf[cell] = positions.length / 3;
        positions.push(...p);
        normals.push(...gradient(solid, p, 1.6e-3).way); // a wide step: creases are shaded softly
        joinCell(values, cell, step, [x, y, z], vertexOf, triangles);
      }
  return { positions, normals, triangles };
}

/** Mean of where the edges of a cell cross the surface [cells], or null. */
function cellVertex(values, cell, step) {
  const sum = [0, 0, 0];
  let count = 0;
  for (let axis = 0; axis < 3; axis++) {
    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    for (let corner = 0; corner < 4; corner++) {
      const from = cell + (corner & 1) * step[u] + (corner >> 1) * step[v];
      const a = values[from], b = values[from + step[axis]];
      if (a < 0 === b < 0) continue;
      sum[axis] += a / (a - b);
      sum[u] += corner & 1;
      sum[v] += corner >> 1;
      count++;
    }
  }
  return count === 0 ? null : sum.map((x) => x / count);
}

/** Two triangles for each edge at the cell's own corner that crosses the surface. */
function joinCell(values, cell, step, at, vertexOf, triangles) {
  for (let axis = 0; axis < 3; axis++) {
    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
    if (at[u] === 0 || at[v] === 0) continue;
    const inside = values[cell] < 0;
    if (inside === values[cell + step[axis]] < 0) continue;
    const quad = [cell, cell - step[u], cell - step[u] - step[v], cell - step[v]].map((c) => vertexOf[c]);
    const [a, b, c, d] = inside ? quad : [quad[0], quad[3], quad[2], quad[1]];
    triangles.push(a, b, c, a, c, d);
  }
}
