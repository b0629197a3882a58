/** A defect of the input; its message is one sentence for users. */
export class InputError extends Error {
  override name = 'InputError';
}

export function damaged(): InputError {
  return new InputError('This file is damaged: download or copy it again.');
}

export function otherVersion(): InputError {
  return new InputError('What this key opens was hidden by another version of keyss.');
}

export function tooMuchLost(): InputError {
  return new InputError('The key is right, but too much of the model was lost or changed.');
}
