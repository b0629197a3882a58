/** Reader of SPZ, versions 2 to 4; `keyss.files.formats.spz` on the other side. */
import { decompress } from 'fzstd';
import { viewOf } from '../core/bytes.ts';
import { InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { checkCount, damagedFile, fromSmallestThree, logit, unpacked } from './coded.ts';

const LEGACY_BYTES = 16;
const HEADER_BYTES = 32;
const MOST_EXTENSION_BYTES = 1 << 20;
const MOST_UNPACKED = 2 ** 31;
const MAGNITUDE = 511;
// Signs of the harmonics of degrees 1 to 3 where y and z change theirs: SPZ has y up, a .ply y down.
const SH_SIGNS = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

interface Sections {
  readonly version: number;
  readonly count: number;
  readonly shDegree: number;
  readonly fractionalBits: number;
  readonly parts: Uint8Array[]; // positions, alphas, colours, scales, rotations, harmonics
}

export async function readSpz(bytes: Uint8Array): Promise<Gaussians> {
  return dequantised(bytes[0] === 0x1f ? await legacy(bytes) : version4(bytes));
}

function header(bytes: Uint8Array, versions: number[], size: number): Omit<Sections, 'parts'> & { sizes: number[] } {
  const view = viewOf(bytes);
  if (bytes.length < LEGACY_BYTES || view.getUint32(0, true) !== 0x5053474e) throw damagedFile(); // NGSP
  const [version, count] = [view.getUint32(4, true), view.getUint32(8, true)];
  const [shDegree, fractionalBits] = [bytes[12], bytes[13]];
  if (!versions.includes(version)) throw new InputError('This SPZ is of a version that cannot be read.');
  checkCount(count, size);
  if (shDegree > 3 || fractionalBits > 24) throw damagedFile();
  const rotation = version === 2 ? 3 : 4;
  const sizes = [9, 1, 3, 3, rotation, 3 * (coefficients(shDegree) - 1)].map((each) => each * count);
  if (sizes.reduce((sum, each) => sum + each, 0) > MOST_UNPACKED) throw damagedFile();
  return { version, count, shDegree, fractionalBits, sizes };
}

async function legacy(bytes: Uint8Array): Promise<Sections> {
  const most = Math.min(MOST_UNPACKED, 64 * Math.max(bytes.length, 1 << 18)) + MOST_EXTENSION_BYTES;
  const data = await unpacked(bytes, 'gzip', most);
  const found = header(data, [2, 3], bytes.length);
  const parts: Uint8Array[] = [];
  let at = LEGACY_BYTES;
  for (const size of found.sizes) {
    if (at + size > data.length) throw damagedFile();
    parts.push(data.subarray(at, at + size));
    at += size;
  }
  return { ...found, parts };
}

function version4(bytes: Uint8Array): Sections {
  const found = header(bytes, [4], bytes.length);
  if (bytes.length < HEADER_BYTES) throw damagedFile();
  const view = viewOf(bytes);
  const [streams, table] = [bytes[15], view.getUint32(16, true)];
  let at = table + 16 * streams;
  if (streams !== found.sizes.filter(Boolean).length || table < HEADER_BYTES || at > bytes.length) throw damagedFile();
  let entry = table;
  const parts = found.sizes.map((size) => {
    if (!size) return new Uint8Array(0);
    const [packed, whole] = [Number(view.getBigUint64(entry, true)), Number(view.getBigUint64(entry + 8, true))];
    entry += 16;
    if (whole !== size || at + packed > bytes.length) throw damagedFile();
    const stream = bytes.subarray(at, at + packed);
    at += packed;
    try {
      const out = decompress(stream, new Uint8Array(size));
      if (out.length !== size) throw damagedFile();
      return out;
    } catch {
      throw damagedFile();
    }
  });
  return { ...found, parts };
}

function dequantised({ version, count, shDegree, fractionalBits, parts }: Sections): Gaussians {
  const [positions, alphas, colours, scales, rotations, harmonics] = parts;
  const model = emptyGaussians(count, shDegree);
  const k = coefficients(shDegree);
  const view = viewOf(rotations);
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      const at = 9 * row + 3 * axis;
      const code = ((positions[at] | (positions[at + 1] << 8) | (positions[at + 2] << 16)) << 8) >> 8;
      model.means[3 * row + axis] = code * 2 ** -fractionalBits * (axis ? -1 : 1);
      model.logScales[3 * row + axis] = scales[3 * row + axis] / 16 - 10;
      model.sh[3 * k * row + axis] = (colours[3 * row + axis] / 255 - 0.5) / 0.15;
    }
    model.opacityLogits[row] = logit(alphas[row]);
    const [x, y, z, w] = quaternion(version, rotations, view, row);
    model.quats.set([w, x, -y, -z], 4 * row);
    for (let each = 0; each < k - 1; each++) {
      for (let colour = 0; colour < 3; colour++) {
        const code = harmonics[3 * ((k - 1) * row + each) + colour];
        model.sh[3 * (k * row + each + 1) + colour] = ((code - 128) / 128) * SH_SIGNS[each];
      }
    }
  }
  return model;
}

function quaternion(version: number, rotations: Uint8Array, view: DataView, row: number): number[] {
  if (version === 2) {
    return fromSmallestThree(3, [0, 1, 2].map((part) => rotations[3 * row + part] / 127.5 - 1));
  }
  const packed = view.getUint32(4 * row, true);
  const others = [20, 10, 0].map((shift) => {
    const part = (packed >>> shift) & 1023;
    return (part & 512 ? -1 : 1) * (part & MAGNITUDE) * (Math.sqrt(0.5) / MAGNITUDE);
  });
  return fromSmallestThree(packed >>> 30, others);
}
