/** The form of both examples: `show` gets the address of a .ply of the model that the key opened in model.ply. */
export function openingForm(show) {
  const [form, status] = [document.querySelector('form'), document.querySelector('output')];
  const worker = new Worker('worker.js', { type: 'module' });
  worker.onmessage = async ({ data: { share, found, error } }) => {
    if (share !== undefined) {
      status.value = `${Math.round(100 * share)} %`;
    } else if (found?.kind === 'model') {
      await show(URL.createObjectURL(new Blob([found.ply])));
      status.value = `${found.gaussians} Gaussians`;
    } else {
      status.value = error ?? 'This key opens nothing here.';
    }
  };
  form.onsubmit = async (event) => {
    event.preventDefault();
    const bytes = new Uint8Array(await (await fetch('model.ply')).arrayBuffer());
    worker.postMessage({ bytes, key: form.elements.key.value });
  };
}
