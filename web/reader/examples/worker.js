// Workers have no import map: with a bundler, import from 'keyss-reader'.
import { reveal } from './node_modules/keyss-reader/index.js';

onmessage = async ({ data: { bytes, key } }) => {
  try {
    const found = await reveal(bytes, key, { onProgress: (share) => postMessage({ share }) });
    postMessage({ found });
  } catch (error) {
    postMessage({ error: error.message });
  }
};
