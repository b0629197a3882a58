/**
 * Opening with a key, in whichever channel of a model the secret lies; `keyss.channels.opening` on the other side.
 *
 * All channels are looked through for every key, also when one of them has opened already: how long it takes tells
 * neither whether a key opens something nor where. Colours come second, with whatever key: they take four times as long as
 * all others together.
 */
import type { ReadModel } from '../files/models.ts';
import type { Derive } from '../keys/keys.ts';
import { AppendedReader } from './appended/reader.ts';
import { ColoursReader } from './colours/reading.ts';
import type { Content, Reader } from './content.ts';
import { QuietReader } from './quiet/reading.ts';

/** A model's channels, prepared for any number of keys: those that are quick to search, and what is left. */
export function preparedFor(model: ReadModel): (thorough: boolean) => Channels {
  const quick = [QuietReader.of(model), AppendedReader.of(model)].filter((each) => each !== null);
  let colours: Reader | null = null;
  return (thorough) => new Channels(thorough ? [(colours ??= ColoursReader.of(model))] : quick);
}

/** Several channels; the first one that opens counts. */
export class Channels implements Reader {
  constructor(readonly readers: readonly Reader[]) {}

  get derivations(): number {
    return this.readers.reduce((sum, each) => sum + each.derivations, 0);
  }

  async open(key: string, derive?: Derive): Promise<Content | null> {
    const outcomes = await Promise.allSettled(this.readers.map((each) => each.open(key, derive)));
    for (const outcome of outcomes) {
      if (outcome.status === 'rejected') throw outcome.reason;
      if (outcome.value !== null) return outcome.value;
    }
    return null;
  }
}
