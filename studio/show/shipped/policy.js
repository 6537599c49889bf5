// The policy: three layers with tanh between them, in float32 as numpy computes them in the exported program.

const floats = (text) => new Float32Array(bytes(text).buffer);

class Policy {
  constructor(layers) {
    this.layers = layers.map(({ weight, bias }) => ({ weight: floats(weight), bias: floats(bias) }));
  }

  /** Return the mean of the policy for what it sees, a Float32Array. */
  mean(seen) {
    let x = seen;
    this.layers.forEach(({ weight, bias }, layer) => {
      const y = new Float32Array(bias.length), last = layer === this.layers.length - 1;
      for (let o = 0, k = 0; o < y.length; o++) {
        let sum = 0;
        for (let i = 0; i < x.length; i++) sum += weight[k++] * x[i];
        y[o] = last ? sum + bias[o] : Math.tanh(Math.fround(sum + bias[o]));
      }
      x = y;
    });
    return x;
  }
}
