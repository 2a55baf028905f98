// Spark and three.js, which travel as spark.bin: a module, compressed to a third (gzip).
export let OrbitControls, PackedSplats, PerspectiveCamera, Scene, SparkRenderer, SplatMesh, Vector3, WebGLRenderer;

/** Resolves once the names above can be used. */
export const unpacked = unpack();

async function unpack() {
  const answer = await fetch(new URL("spark.bin", import.meta.url));
  if (!answer.ok) throw new Error(`spark.bin is missing (${answer.status}): write the page again.`);
  const code = await new Response(answer.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  const address = URL.createObjectURL(new Blob([code], { type: "text/javascript" }));
  ({ OrbitControls, PackedSplats, PerspectiveCamera, Scene, SparkRenderer, SplatMesh, Vector3, WebGLRenderer } = await import(address));
}
