/** Compressed streams of bounded size. */
import { Decompress } from 'fzstd';
import { damaged } from './errors.ts';
import { joined } from './bytes.ts';

// The frame header of `unpackedZstd`: a window of 4 MiB, no size, no checksum.
const ZSTD_FRAME = Uint8Array.of(0x28, 0xb5, 0x2f, 0xfd, 0, (22 - 10) << 3);
const RLE_BLOCK = 1;

/** What a stream becomes, at most `most` bytes. Raises InputError for more and for damage. */
export async function unpacked(
  bytes: Uint8Array, format: 'gzip' | 'deflate' | 'deflate-raw', most: number,
): Promise<Uint8Array> {
  const found = new Parts(most);
  try {
    const reader = new Blob([bytes as BlobPart]).stream().pipeThrough(new DecompressionStream(format)).getReader();
    for (let { done, value } = await reader.read(); !done; { done, value } = await reader.read()) found.add(value!);
  } catch {
    throw damaged();
  }
  return found.whole();
}

/** What the blocks of one zstd frame without its header become, `size` bytes. Raises InputError. */
export function unpackedZstd(blocks: Uint8Array, size: number): Uint8Array {
  const found = new Parts(size);
  try {
    if (frameEnd(blocks) !== blocks.length) throw damaged();
    new Decompress((part) => found.add(part)).push(joined(ZSTD_FRAME, blocks), true);
  } catch {
    throw damaged();
  }
  if (found.size !== size) throw damaged();
  return found.whole();
}

/** Where the last block of a frame ends: fzstd would go on to further frames, with windows of any size. */
function frameEnd(blocks: Uint8Array): number {
  for (let at = 0; ; ) {
    const header = blocks[at] | (blocks[at + 1] << 8) | (blocks[at + 2] << 16);
    at += 3 + (((header >> 1) & 3) === RLE_BLOCK ? 1 : header >> 3);
    if (header & 1 || at >= blocks.length) return at;
  }
}

/** Parts of a whole that may have at most `most` bytes. */
class Parts {
  size = 0;
  private readonly parts: Uint8Array[] = [];

  constructor(private readonly most: number) {}

  add(part: Uint8Array): void {
    this.size += part.length;
    if (this.size > this.most) throw damaged();
    this.parts.push(part);
  }

  whole(): Uint8Array {
    return joined(...this.parts);
  }
}

