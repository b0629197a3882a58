/** Something about a file that a person can be told in one sentence. */
export class InputError extends Error {
  override name = 'InputError';
}
