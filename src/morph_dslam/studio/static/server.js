// What the pages ask the server, and what it says by itself.

async function told(response) {
  if (!response.ok) throw new Error(await response.text());
  return response;
}

// A packed answer: the length of its head, a JSON head, then arrays.
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  for (const [name, type, size] of facts.arrays) {
    facts[name] = new (type === '<f4' ? Float32Array : Int32Array)(buffer, offset, size);
    offset += 4 * size;
  }
  return facts;
}

export async function call(action, content = {}) {
  const response = await told(await fetch(`/api/${action}`, { method: 'POST', body: JSON.stringify(content) }));
  const isJson = response.headers.get('content-type').startsWith('application/json');
  return isJson ? response.json() : unpack(await response.arrayBuffer());
}

export async function state() {
  return (await told(await fetch('/api/state'))).json();
}

export async function explored(path) {
  return (await told(await fetch(`/explore/${path}`))).json();
}

export async function frame(number) {
  return createImageBitmap(await (await told(await fetch(`/api/frame/${number}`))).blob());
}

export async function scanFrame(number) {
  return createImageBitmap(await (await told(await fetch(`/api/scan/${number}`))).blob());
}

// Names become what the project takes: letters, digits and a few signs.
export function properName(name) {
  const plain = name.normalize('NFKD').replace(/[^A-Za-z0-9_. ()+-]/g, '_').slice(-100);
  return plain.replace(/^[^A-Za-z0-9_]+/, '') || 'file';
}

export async function upload(kind, file) {
  const name = properName(file.name);
  await told(await fetch(`/api/upload/${kind}/${encodeURIComponent(name)}`, { method: 'PUT', body: file }));
  return name;
}

export function listen(handlers) {
  const source = new EventSource('/api/events');
  for (const [name, handler] of Object.entries(handlers)) {
    source.addEventListener(name, (event) => handler(JSON.parse(event.data)));
  }
}
