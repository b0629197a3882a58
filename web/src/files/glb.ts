/** Reader of .glb with KHR_gaussian_splatting; `keyss.files.formats.glb` on the other side. */
import { InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { isSimilarity, moved, type Similarity } from '../core/similarity.ts';
import { damagedFile, logitOf, logScale, unitQuat } from './coded.ts';
import { chunksOf, type Document, EXTENSION, type Node, type Primitive, values } from './gltf.ts';
import { checkedFinite } from './ply.ts';

/** [4, 4] in rows. */
type Matrix = readonly number[];

const COUNTS = [1, 3, 5, 7]; // coefficients of each degree
const MOST_DEPTH = 64; // of nodes in nodes
const MOST_PARTS = 64; // that show Gaussians
const LEAST_BYTES = 16; // that a Gaussian takes
const IDENTITY: Matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
// glTF has y up: the frame of a .ply is taken for one turned by 180 degrees about z, as by other converters.
const TURN: Matrix = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** All Gaussians of a file's scene, as one model in the frame of a .ply. Raises InputError. */
export function readGlb(bytes: Uint8Array): Gaussians {
  const { document, binary } = chunksOf(bytes);
  const parts: Gaussians[] = [];
  let room = Math.floor(bytes.length / LEAST_BYTES); // Gaussians; one that is shown twice counts twice
  try {
    for (const [placed, primitive] of shown(document)) {
      const model = gaussiansOf(document, primitive, binary);
      room -= model.count;
      if (room < 0 || parts.length === MOST_PARTS) throw damagedFile();
      parts.push(inFrameOfPly(model, placed));
    }
  } catch (error) {
    if (error instanceof InputError) throw error;
    throw damagedFile(); // its JSON has something else where lists and numbers should be
  }
  if (!parts.length) throw new InputError('This .glb holds no Gaussians.');
  return checkedFinite(parts.length === 1 ? parts[0] : together(parts));
}

/** What shows Gaussians in the scene, each with the transform from its coordinates to the scene's. */
function* shown(document: Document): Generator<[Matrix, Primitive]> {
  const nodes = document.nodes ?? [];
  const roots = document.scenes?.length ? (document.scenes[document.scene ?? 0].nodes ?? []) : [...nodes.keys()];
  const left = roots.map((index) => ({ index, above: IDENTITY, depth: 0 }));
  const seen = new Set<number>();
  for (let next = left.pop(); next; next = left.pop()) {
    const { index, above, depth } = next;
    const node = nodes[index];
    if (!node || seen.has(index) || depth > MOST_DEPTH) throw damagedFile();
    seen.add(index);
    const here = product(above, transformOf(node));
    for (const child of node.children ?? []) left.push({ index: child, above: here, depth: depth + 1 });
    if (node.mesh === undefined || node.mesh === null) continue;
    for (const primitive of document.meshes![node.mesh].primitives) {
      if (primitive.extensions?.[EXTENSION]) yield [here, primitive];
    }
  }
}

/** To the coordinates of the node above. Raises InputError. */
function transformOf({ matrix, translation, rotation, scale }: Node): Matrix {
  let found: number[];
  if (matrix) {
    found = Array.from({ length: 16 }, (_, at) => matrix[4 * (at % 4) + Math.floor(at / 4)]); // columns come first there
  } else {
    const [x, y, z, w] = rotation ?? [0, 0, 0, 1];
    const [a, b, c, d] = [x, y, z, w].map((each) => each / Math.hypot(x, y, z, w));
    const [tx, ty, tz] = translation ?? [0, 0, 0];
    const [sx, sy, sz] = scale ?? [1, 1, 1];
    found = [
      (a * a - b * b - c * c + d * d) * sx, 2 * (a * b - c * d) * sy, 2 * (a * c + b * d) * sz, tx,
      2 * (a * b + c * d) * sx, (-a * a + b * b - c * c + d * d) * sy, 2 * (b * c - a * d) * sz, ty,
      2 * (a * c - b * d) * sx, 2 * (b * c + a * d) * sy, (-a * a - b * b + c * c + d * d) * sz, tz,
      0, 0, 0, 1,
    ];
  }
  if (!found.every((each) => Number.isFinite(each))) throw damagedFile();
  return found;
}

/** The Gaussians of a primitive, in its own coordinates. */
function gaussiansOf(document: Document, primitive: Primitive, binary: Uint8Array): Gaussians {
  if ('extensions' in primitive.extensions![EXTENSION]) {
    throw new InputError('This .glb has its Gaussians compressed in a way that cannot be read.');
  }
  const attribute = (name: string, width: number): Float64Array =>
    values(document, primitive.attributes[name] ?? -1, width, binary);
  const degree = [3, 2, 1].find((each) => `${EXTENSION}:SH_DEGREE_${each}_COEF_0` in primitive.attributes) ?? 0;
  const means = attribute('POSITION', 3);
  const model = emptyGaussians(means.length / 3, degree);
  const quats = attribute(`${EXTENSION}:ROTATION`, 4);
  const scales = attribute(`${EXTENSION}:SCALE`, 3);
  const opacities = attribute(`${EXTENSION}:OPACITY`, 1);
  const fits = quats.length === 4 * model.count && scales.length === means.length && opacities.length === model.count;
  if (!model.count || !fits || !opacities.every((each) => each >= 0 && each <= 1)) throw damagedFile();
  model.means.set(means);
  model.logScales.set(scales.map(logScale));
  model.opacityLogits.set(opacities.map(logitOf));
  for (let row = 0; row < model.count; row++) {
    const [x, y, z, w] = quats.subarray(4 * row, 4 * row + 4);
    model.quats.set(unitQuat(w, x, y, z), 4 * row);
  }
  const k = coefficients(degree);
  const names = COUNTS.slice(0, degree + 1).flatMap((count, of) =>
    Array.from({ length: count }, (_, index) => `${EXTENSION}:SH_DEGREE_${of}_COEF_${index}`));
  names.forEach((name, each) => {
    const colours = attribute(name, 3);
    if (colours.length !== means.length) throw damagedFile();
    for (let row = 0; row < model.count; row++) {
      model.sh.set(colours.subarray(3 * row, 3 * row + 3), 3 * (k * row + each));
    }
  });
  return model;
}

function inFrameOfPly(model: Gaussians, placed: Matrix): Gaussians {
  const whole = product(TURN, placed);
  if (whole.every((each, at) => each === IDENTITY[at])) return model;
  return moved(similarityOf(whole), model);
}

function product(a: Matrix, b: Matrix): Matrix {
  const at = (row: number, column: number): number =>
    [0, 1, 2, 3].reduce((sum, each) => sum + a[4 * row + each] * b[4 * each + column], 0);
  return Array.from({ length: 16 }, (_, index) => at(Math.floor(index / 4), index % 4));
}

/** Raises InputError for a transform that does more than move, turn and scale evenly. */
function similarityOf(whole: Matrix): Similarity {
  const linear = [0, 1, 2].flatMap((row) => whole.slice(4 * row, 4 * row + 3));
  const [a, b, c, d, e, f, g, h, i] = linear;
  const determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
  const scale = Math.abs(determinant) ** (1 / 3);
  const rotation = linear.map((each) => each / scale);
  const found = { scale, rotation, translation: [whole[3], whole[7], whole[11]] };
  if (isSimilarity(found)) return found;
  throw new InputError('This .glb does more to its Gaussians than move, turn and scale them evenly.');
}

/** One model of several, of their largest degree. */
function together(parts: readonly Gaussians[]): Gaussians {
  const degree = Math.max(...parts.map((each) => each.shDegree));
  const whole = emptyGaussians(parts.reduce((sum, each) => sum + each.count, 0), degree);
  let first = 0;
  for (const part of parts) {
    whole.means.set(part.means, 3 * first);
    whole.quats.set(part.quats, 4 * first);
    whole.logScales.set(part.logScales, 3 * first);
    whole.opacityLogits.set(part.opacityLogits, first);
    const [from, to] = [3 * coefficients(part.shDegree), 3 * coefficients(degree)];
    for (let row = 0; row < part.count; row++) {
      whole.sh.set(part.sh.subarray(row * from, (row + 1) * from), (first + row) * to);
    }
    first += part.count;
  }
  return whole;
}
