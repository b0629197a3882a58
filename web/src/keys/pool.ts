/** Deriving many keys: one after the other, or several side by side. */
import { type Derive, master } from './derivation.ts';

/** `derive` for one key after the other, however many are asked for at once: each takes 64 MiB. */
export function oneByOne(derive: Derive): Derive {
  let last: Promise<unknown> = Promise.resolve();
  return (key, salt) => {
    const own = last.then(() => derive(key, salt));
    last = own.catch(() => undefined);
    return own;
  };
}

/** Several that derive keys, each in turn. */
export function inTurn(derives: readonly Derive[]): Derive {
  let next = 0;
  return (key, salt) => derives[next++ % derives.length](key, salt);
}

/** In this thread. */
export const here: Derive = oneByOne(master);

/** By whoever answers at the other end of a port, in order. */
export function derivedBy(port: MessagePort): Derive {
  const waiting: ((found: Uint8Array | null) => void)[] = [];
  port.onmessage = ({ data }: MessageEvent<Uint8Array | null>) => waiting.shift()?.(data);
  return (key, salt) =>
    new Promise((resolve, reject) => {
      waiting.push((found) => (found === null ? reject(new Error('no memory')) : resolve(found)));
      port.postMessage({ key, salt });
    });
}

/** Answers `derivedBy` at the other end. */
export function answering(port: MessagePort): void {
  port.onmessage = ({ data }: MessageEvent<{ key: string; salt: Uint8Array }>) => {
    void here(data.key, data.salt).then(
      (found) => port.postMessage(found),
      () => port.postMessage(null),
    );
  };
}
