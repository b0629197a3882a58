/** Other people's readers in a page: tests/viewer/test_judges.py asks them what is in the files that keyss writes. */
import { SplatMesh } from '@sparkjsdev/spark';
import {
  AppBase, AppOptions, Asset, CameraComponentSystem, createGraphicsDevice, GSplatComponentSystem, GSplatHandler,
  TextureHandler,
} from 'playcanvas';

interface Judged {
  readonly count: number;
  readonly means: number[]; // [N, 3], in any order
}

async function spark(url: string): Promise<Judged> {
  const mesh = new SplatMesh({ url });
  await mesh.initialized;
  const means: number[] = [];
  mesh.forEachSplat((_index, centre) => means.push(centre.x, centre.y, centre.z));
  return { count: means.length / 3, means };
}

async function playcanvas(url: string): Promise<Judged> {
  const canvas = document.createElement('canvas');
  const options = new AppOptions();
  options.graphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: ['webgl2'] } as object);
  options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
  options.resourceHandlers = [TextureHandler, GSplatHandler];
  const app = new AppBase(canvas);
  app.init(options);
  const asset = new Asset(url, 'gsplat', { url });
  app.assets.add(asset);
  await new Promise<void>((resolve, reject) => {
    asset.ready(() => resolve());
    asset.once('error', (error: unknown) => reject(new Error(String(error))));
    app.assets.load(asset);
  });
  const { centers, numSplats } = asset.resource as unknown as { centers: Float32Array; numSplats: number };
  return { count: numSplats, means: Array.from(centers.subarray(0, 3 * numSplats)) };
}

Object.assign(window, { judges: { spark, playcanvas } });
