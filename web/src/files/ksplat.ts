/** Reader of .ksplat: sections of buckets, of three levels; `keyss.files.formats.ksplat` on the other side. */
import { halfFloat, viewOf } from '../core/bytes.ts';
import { InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { checkCount, constantHarmonic, damagedFile, logit, logScale, unitQuat } from './coded.ts';
import { checkedFinite } from './ply.ts';

const HEADER_BYTES = 4096;
const SECTION_BYTES = 1024;
const SH_RANGE = 1.5; // where a file gives none
const FINEST = 32767; // half the range of a position's code, likewise
const BUCKET_BYTES = 12; // a centre

type Read = (at: number) => number;

/** What a level has its numbers in: bytes of each, and how it is read. */
interface Level {
  readonly position: number;
  readonly number: number;
  readonly harmonic: number;
  readonly readPosition: Read;
  readonly readNumber: Read;
  readonly readHarmonic: Read;
}

interface Section {
  readonly count: number; // Gaussians
  readonly room: number; // Gaussians that it has room for
  readonly bucket: number; // Gaussians of a full bucket
  readonly buckets: number;
  readonly block: number; // side of a bucket in world units
  readonly bucketBytes: number;
  readonly finest: number;
  readonly full: number; // buckets
  readonly partial: number; // buckets
  readonly degree: number;
  readonly start: number; // byte of the file
}

/** The model in a file, of the largest degree of its sections. Raises InputError. */
export function readKsplat(bytes: Uint8Array): Gaussians {
  if (bytes.length < HEADER_BYTES) throw damagedFile();
  const view = viewOf(bytes);
  const [major, minor, level] = [bytes[0], bytes[1], view.getUint16(20, true)];
  if (major !== 0 || minor < 1 || level > 2) throw new InputError('This .ksplat is of a version that cannot be read.');
  const [room, count] = [view.getUint32(4, true), view.getUint32(16, true)];
  checkCount(count, bytes.length);
  let at = HEADER_BYTES + room * SECTION_BYTES;
  if (at > bytes.length) throw damagedFile();
  const [low, high] = [view.getFloat32(36, true) || -SH_RANGE, view.getFloat32(40, true) || SH_RANGE];
  const kind = levelOf(level, view, low, high);
  const sections: Section[] = [];
  for (let index = 0; index < room; index++) {
    const section = sectionOf(view, HEADER_BYTES + index * SECTION_BYTES, at);
    at = endOf(section, kind, bytes.length, level);
    sections.push(section);
  }
  if (sections.reduce((sum, each) => sum + each.count, 0) !== count) throw damagedFile();
  const degree = Math.max(...sections.filter((each) => each.count).map((each) => each.degree));
  const model = emptyGaussians(count, degree);
  let row = 0;
  for (const section of sections) {
    put(model, row, section, kind, view, level);
    row += section.count;
  }
  return checkedFinite(model);
}

function levelOf(level: number, view: DataView, low: number, high: number): Level {
  const float: Read = (at) => view.getFloat32(at, true);
  if (level === 0) {
    return { position: 4, number: 4, harmonic: 4, readPosition: float, readNumber: float, readHarmonic: float };
  }
  const half: Read = (at) => halfFloat(view.getUint16(at, true));
  const code: Read = (at) => view.getUint16(at, true);
  const whole = { position: 2, number: 2, readPosition: code, readNumber: half };
  if (level === 1) return { ...whole, harmonic: 2, readHarmonic: half };
  return { ...whole, harmonic: 1, readHarmonic: (at) => low + (view.getUint8(at) / 255) * (high - low) };
}

function sectionOf(view: DataView, header: number, start: number): Section {
  const integer = (offset: number): number => view.getUint32(header + offset, true);
  const degree = view.getUint16(header + 40, true);
  if (degree > 3) throw damagedFile();
  return {
    count: integer(0), room: integer(4), bucket: integer(8), buckets: integer(12),
    block: view.getFloat32(header + 16, true), bucketBytes: view.getUint16(header + 20, true),
    finest: integer(24) || FINEST, full: integer(32), partial: integer(36), degree, start,
  };
}

function rowBytes({ degree }: Section, kind: Level): number {
  return 3 * kind.position + 7 * kind.number + 4 + 3 * (coefficients(degree) - 1) * kind.harmonic;
}

/** Where a section's Gaussians begin: after the sizes of partly filled buckets and the centres of all. */
function rowsAt(section: Section): number {
  return section.start + 4 * section.partial + section.bucketBytes * section.buckets;
}

/** Where the next section begins. Raises InputError for one that lies outside of the file. */
function endOf(section: Section, kind: Level, size: number, level: number): number {
  const end = rowsAt(section) + section.room * rowBytes(section, kind);
  if (end > size || section.count > section.room || (level && section.bucketBytes !== BUCKET_BYTES)) {
    throw damagedFile();
  }
  return end;
}

function put(model: Gaussians, first: number, section: Section, kind: Level, view: DataView, level: number): void {
  const [k, size] = [coefficients(model.shDegree), rowBytes(section, kind)];
  const bucketOf = bucketsOf(section, view);
  const centres = section.start + 4 * section.partial;
  const factor = section.block / 2 / section.finest;
  for (let index = 0; index < section.count; index++) {
    const [row, bucket] = [first + index, level ? bucketOf() : 0];
    let at = rowsAt(section) + index * size;
    const next = (read: Read, width: number): number => {
      at += width;
      return read(at - width);
    };
    for (let axis = 0; axis < 3; axis++) {
      const value = next(kind.readPosition, kind.position);
      const centre = level ? view.getFloat32(centres + BUCKET_BYTES * bucket + 4 * axis, true) : 0;
      model.means[3 * row + axis] = level ? (value - section.finest) * factor + centre : value;
    }
    for (let axis = 0; axis < 3; axis++) model.logScales[3 * row + axis] = logScale(next(kind.readNumber, kind.number));
    const [w, x, y, z] = [0, 1, 2, 3].map(() => next(kind.readNumber, kind.number));
    model.quats.set(unitQuat(w, x, y, z), 4 * row);
    for (let colour = 0; colour < 3; colour++) {
      model.sh[3 * k * row + colour] = constantHarmonic(next((place) => view.getUint8(place), 1));
    }
    model.opacityLogits[row] = logit(next((place) => view.getUint8(place), 1));
    // Degree by degree, each with all red ones first.
    for (let degree = 1; degree <= section.degree; degree++) {
      for (let colour = 0; colour < 3; colour++) {
        for (let each = degree * degree; each < (degree + 1) ** 2; each++) {
          model.sh[3 * (k * row + each) + colour] = next(kind.readHarmonic, kind.harmonic);
        }
      }
    }
  }
}

/** What gives the bucket of one Gaussian of a section after the other: the full ones come first. */
function bucketsOf(section: Section, view: DataView): () => number {
  let [bucket, left, filled] = [-1, 0, 0];
  return () => {
    while (left === 0) {
      bucket++;
      if (bucket >= section.buckets) throw damagedFile();
      if (bucket < section.full) left = section.bucket;
      else if (filled < section.partial) left = view.getUint32(section.start + 4 * filled++, true);
      else throw damagedFile();
    }
    left--;
    return bucket;
  };
}
