/** Worker that derives keys by Argon2id. */
import { here } from './keys/keys.ts';

self.onmessage = ({ data }: MessageEvent<{ key: string; salt: Uint8Array }>) => {
  void here(data.key, data.salt).then((found) => self.postMessage(found), () => self.postMessage(null));
};
