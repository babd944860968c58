/** A file input in a label onto which files can be dropped: `take` gets the files of either way. */
export function setUpDropZone(input, take) {
  const zone = input.parentElement;
  input.onchange = async () => {
    await take(input.files);
    input.value = ""; // else the same file cannot be chosen again
  };
  zone.ondragover = (event) => {
    event.preventDefault();
    zone.classList.add("target");
  };
  zone.ondragleave = () => zone.classList.remove("target");
  zone.ondrop = (event) => {
    event.preventDefault();
    zone.classList.remove("target");
    take(event.dataTransfer.files);
  };
}
