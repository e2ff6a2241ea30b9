"""What a render needs: the picture and its gradients, tiles, pairs, the view, projected Gaussians."""
