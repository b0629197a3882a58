/** Opening with a key, in whichever channel of a model the secret lies; `keyss.channels.opening` on the other side. */
import type { ReadModel } from '../files/models.ts';
import { CodesReader } from './codes/reader.ts';
import type { Reader } from './content.ts';
import { LowBitsReader } from './low_bits/reader.ts';

/** The channels of a model, prepared for any number of keys; null where there is room for nothing. */
export function readerOf(model: ReadModel): Reader | null {
  return model.codes ? CodesReader.of(model.codes) : LowBitsReader.of(model);
}
