/** Files of a ZIP archive, stored or deflated, of bounded size. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { unpacked } from '../core/unpacking.ts';

const [END, CENTRAL, LOCAL] = [0x06054b50, 0x02014b50, 0x04034b50];
const MAX_MEMBERS = 64;
const MAX_COMMENT = 65557; // bytes of the end of the directory, its comment included
const SMALL = 1 << 20;

/** What gives a member by its name. Raises InputError for what is no whole archive. */
export function openZip(bytes: Uint8Array): (name: string) => Promise<Uint8Array> {
  const view = viewOf(bytes);
  let end = bytes.length - 22;
  const last = Math.max(0, bytes.length - MAX_COMMENT);
  while (end >= last && view.getUint32(end, true) !== END) end--;
  if (end < last) throw damaged();
  const count = view.getUint16(end + 10, true);
  if (count > MAX_MEMBERS) throw damaged();
  const members = new Map<string, { method: number; packed: number; size: number; at: number }>();
  let at = view.getUint32(end + 16, true);
  for (let index = 0; index < count; index++) {
    if (at + 46 > bytes.length || view.getUint32(at, true) !== CENTRAL) throw damaged();
    const [nameSize, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const name = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + nameSize));
    members.set(name, {
      method: view.getUint16(at + 10, true), packed: view.getUint32(at + 20, true),
      size: view.getUint32(at + 24, true), at: view.getUint32(at + 42, true),
    });
    at += 46 + nameSize + extra + comment;
  }
  return async (name) => {
    const found = members.get(name);
    if (!found || found.at + 30 > bytes.length || view.getUint32(found.at, true) !== LOCAL) throw damaged();
    const start = found.at + 30 + view.getUint16(found.at + 26, true) + view.getUint16(found.at + 28, true);
    const data = bytes.subarray(start, start + found.packed);
    if (data.length !== found.packed || found.size > Math.max(SMALL, 2 * bytes.length)) throw damaged();
    if (found.method === 0) return data;
    if (found.method === 8) return unpacked(data, 'deflate-raw', found.size);
    throw damaged();
  };
}
