/** Opening with a key, in whichever channel of a model the secret lies. */
import type { Gaussians } from '../core/gaussians.ts';
import type { Reader } from './content.ts';
import { LowBitsReader } from './low_bits/reader.ts';

/** The channels of a model, prepared for any number of keys. */
export function readerOf(model: Gaussians): Reader {
  return LowBitsReader.of(model);
}
