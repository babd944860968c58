// Two pictures on top of each other with a draggable divider: a range input, so that keys and screen readers move it.

export function setUpDivider(stack, split, zoom) {
  const move = () => {
    stack.style.setProperty("--split", `${split.value}%`);
    split.setAttribute("aria-valuetext", `measurement ${split.value} per cent, reconstruction ${100 - split.value} per cent`);
  };
  const enlarge = () => {
    stack.style.setProperty("--zoom", zoom.value);
    stack.classList.toggle("near", Number(zoom.value) > 2);
  };
  split.oninput = move;
  zoom.oninput = enlarge;
  move();
  enlarge();
}

export async function setPicture(image, blob) {
  const before = image.src;
  const address = (image.src = URL.createObjectURL(blob));
  try {
    await image.decode();
  } catch (error) {
    if (image.src === address) throw error; // else a newer picture has taken its place
  }
  if (before.startsWith("blob:")) URL.revokeObjectURL(before);
}
