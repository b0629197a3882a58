/** A secret that is a file. */
import type { Content } from '../channels/content.ts';

export interface HiddenFile {
  readonly name: string; // as its sender had it: to be shown, and never to be taken as a path
  readonly bytes: Uint8Array;
}

/** Null for what is no file. */
export function fileOf(content: Content): HiddenFile | null {
  if (content.service !== 'payload' || content.method !== 'file') return null;
  const size = content.data[0];
  return { name: new TextDecoder().decode(content.data.subarray(1, 1 + size)), bytes: content.data.slice(1 + size) };
}
