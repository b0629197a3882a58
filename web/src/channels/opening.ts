/**
 * Opens a secret with a key in any channel of a model; counterpart of `keyss.channels.publishing`.
 *
 * Every key searches all channels, even after one has opened, so that timing reveals neither whether a key opens
 * something nor where. Colours are searched last, as they take four times as long as all others together.
 */
import type { Gaussians } from '../core/gaussians.ts';
import type { ReadModel } from '../files/models.ts';
import type { Derive } from '../keys/keys.ts';
import { AppendedReader } from './appended/appended_reader.ts';
import type { Payload, Reader } from './container.ts';
import { copies } from './foreign.ts';
import { ColoursReader } from './colours/colours_reader.ts';
import { LsbReader } from './lsb/reading.ts';

/** A model's channels, prepared for any number of keys: the quick ones, or the thorough search of colours. */
export async function channelsOf(model: ReadModel, thorough: boolean): Promise<Channels> {
  const readers = thorough ? [ColoursReader.of(model)] : [await LsbReader.of(model), AppendedReader.of(model)];
  return new Channels(readers.filter((each) => each !== null), model);
}

/** Several channels; the first that opens wins. */
export class Channels implements Reader {
  private readonly copies: number;

  /** `model`: of these channels, searched for copies. */
  constructor(readonly readers: readonly Reader[], model: Gaussians) {
    this.copies = copies(model);
  }

  get derivations(): number {
    return this.readers.reduce((sum, each) => sum + each.derivations, 0);
  }

  async open(key: string, derive?: Derive): Promise<Payload | null> {
    const outcomes = await Promise.allSettled(this.readers.map((each) => each.open(key, derive)));
    for (const outcome of outcomes) {
      if (outcome.status === 'rejected') throw outcome.reason;
      const found = outcome.value;
      if (found !== null) return { ...found, foreign: found.foreign || this.copies || undefined };
    }
    return null;
  }
}
