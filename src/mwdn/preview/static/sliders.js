// Options of a method as sliders: a range of decades is logarithmic.

let current = [];

const format = (value) => (value === null ? "automatic" : Number(value.toPrecision(3)).toString());

export function drawSliders(place, options, changed, values = {}) {
  current = [];
  place.replaceChildren();
  for (const option of options.filter(({ low }) => low !== null)) {
    const logarithmic = option.high / option.low > 1000;
    const [to, from] = logarithmic ? [Math.log10, (x) => 10 ** x] : [(x) => x, Math.round];
    const id = `option-${option.name}`;
    const label = Object.assign(document.createElement("label"), { htmlFor: id, title: option.about });
    const value = document.createElement("output");
    label.append(`${option.name} `, value);
    const isSet = option.name in values;
    const chosen = isSet ? values[option.name] : option.default;
    const start = chosen ?? (logarithmic ? Math.sqrt(option.low * option.high) : option.low);
    const slider = Object.assign(document.createElement("input"), {
      id, type: "range", min: to(option.low), max: to(option.high), step: logarithmic ? "any" : 1,
    });
    slider.value = to(start);
    const state = { name: option.name, value: chosen, isSet };
    current.push(state);
    value.textContent = format(chosen);
    slider.oninput = () => {
      Object.assign(state, { value: from(Number(slider.value)), isSet: true });
      value.textContent = format(state.value);
      slider.setAttribute("aria-valuetext", value.textContent);
      changed();
    };
    place.append(label, slider);
  }
}

export function readSliders() {
  return Object.fromEntries(current.filter(({ isSet }) => isSet).map(({ name, value }) => [name, value]));
}
