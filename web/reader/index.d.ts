export interface Foreign {
  /**
   * About how many Gaussians were added to the published file or changed in it, if so many that somebody may have chosen
   * which secret the key opens: tell the user.
   */
  readonly foreign?: number;
}

/** A 3D Gaussian Splatting model that a key opened, as a .ply of its own. */
export interface RevealedModel extends Foreign {
  readonly kind: 'model';
  readonly ply: Uint8Array;
  readonly gaussians: number;
}

/** A file that a key opened. */
export interface RevealedFile extends Foreign {
  readonly kind: 'file';
  /** As its sender had it. Show it, and do not use it as a path. */
  readonly name: string;
  readonly bytes: Uint8Array;
}

export interface RevealOptions {
  /** Name of the published file. Only `.splat` files are recognised by it; all others by their first bytes. */
  readonly name?: string;
  /** Ends the search: `reveal` rejects with the signal's reason. */
  readonly signal?: AbortSignal;
  /** Receives 0 to 1, at the same points for every key until one opens something. */
  readonly onProgress?: (share: number) => void;
  /**
   * Decodes a lossless WebP image to RGBA bytes, row by row, not premultiplied by alpha. Only `.sog` files contain
   * images. Browsers do not need it.
   */
  readonly decodeWebP?: (webp: Uint8Array) => Promise<Uint8Array>;
}

/**
 * What `key` opens in the bytes of a published model, or null for nothing. The bytes are not changed.
 *
 * Rejects with an `InputError` (an Error with this name and a message of one sentence) if the bytes are not a model, if the
 * key has no or more than 4,096 bytes, or if the key is right and the model was damaged too much or needs
 * `keyss reveal`.
 */
export declare function reveal(
  bytes: Uint8Array, key: string, options?: RevealOptions,
): Promise<RevealedModel | RevealedFile | null>;

export type Reveal = typeof reveal;
