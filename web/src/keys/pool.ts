/** Several that derive keys, as one: each has one to derive at a time, and the rest waits in order. */
import type { Derive } from './derivation.ts';

export function pooled(idle: readonly Derive[]): Derive {
  const free = [...idle];
  const waiting: ((derive: Derive) => void)[] = [];
  const taken = (): Promise<Derive> => {
    const own = free.shift();
    return own ? Promise.resolve(own) : new Promise((resolve) => waiting.push(resolve));
  };
  return async (key, salt) => {
    const own = await taken();
    try {
      return await own(key, salt);
    } finally {
      const next = waiting.shift();
      if (next) next(own);
      else free.push(own);
    }
  };
}
