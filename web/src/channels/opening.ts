/**
 * Opens a secret with a key in any channel of a model; counterpart of `keyss.channels.publishing`.
 *
 * Every key searches all channels, even after one has opened, so that timing reveals neither whether a key opens
 * something nor where. Colours are searched last, as they take four times as long as all others together.
 */
import type { Gaussians } from '../core/gaussians.ts';
import type { ReadModel } from '../files/models.ts';
import { appendedReader } from './appended/appended_reader.ts';
import type { Reader } from './container.ts';
import { copies } from './foreign.ts';
import { coloursReader } from './colours/colours_reader.ts';
import { lsbReader } from './lsb/reading.ts';

/** A model's channels, prepared for any number of keys: the quick ones, or the thorough search of colours. */
export async function channelsOf(model: ReadModel, thorough: boolean): Promise<Reader> {
  const readers = thorough ? [coloursReader(model)] : [await lsbReader(model), appendedReader(model)];
  return firstOf(readers.filter((each) => each !== null), model);
}

/** Reads several channels of a model, which is searched for copies; the first that opens wins. */
export function firstOf(readers: readonly Reader[], model: Gaussians): Reader {
  const suspicious = copies(model);
  return {
    derivations: readers.reduce((sum, each) => sum + each.derivations, 0),
    async open(key, derive) {
      const outcomes = await Promise.allSettled(readers.map((each) => each.open(key, derive)));
      for (const outcome of outcomes) {
        if (outcome.status === 'rejected') throw outcome.reason;
        const found = outcome.value;
        if (found !== null) return { ...found, foreign: found.foreign || suspicious || undefined };
      }
      return null;
    },
  };
}
